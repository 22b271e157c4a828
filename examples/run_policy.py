"""Run an exported policy with numpy and onnxruntime alone.

Everything else comes from the policy's folder: `policy.json` holds order, scale, history, rate,
limits and the end of an episode, `policy.onnx` the network, `golden.json` answers to compare with.

    python examples/run_policy.py tasks/policies/borehole_insertion
"""

import json
import sys
from pathlib import Path

import numpy as np
import onnxruntime


class ExportedPolicy:
    """A policy folder of `brokk mode=train` or `mode=export`."""

    def __init__(self, folder):
        self.contract = json.loads((Path(folder) / "policy.json").read_text())
        self.session = onnxruntime.InferenceSession(str(Path(folder) / "policy.onnx"))
        self.q = self.u = None  # no history yet

    def step(self, target_m, q, u, pitch_rad=0.0, proposals=0.0):
        """Return the command for the next period, (J,); call it `rate_hz` times a second.

        `target_m` is the target in the base frame, `q` the measured positions, `u` the commands that
        were in force since the last call. `proposals` is the (H, J) history of a policy that
        proposes to a person.
        """
        num = self.contract["history"]["samples"]
        if self.q is None:  # before the first sample the arm rested here
            self.q, self.u = np.tile(q, (num, 1)), np.zeros((num, len(q)))
        else:
            self.q, self.u = np.vstack((self.q[1:], q)), np.vstack((self.u[1:], u))
        return self.command(self.observe(target_m, self.q, self.u, pitch_rad, proposals))

    def observe(self, target_m, q, u, pitch_rad=0.0, proposals=0.0):
        """Return the observation vector of histories (H, J), oldest sample first."""
        scale = self.contract["observation"]
        target, pitch = scale["target"], scale.get("pitch", {"mean_rad": 0.0, "std_rad": 1.0})
        parts = {
            "target_in_base_m": (target_m - np.array(target["mean_m"])) / target["std_m"],
            "q": (q - np.array(scale["q"]["mean"])) / scale["q"]["std"],
            "u": (u - np.array(scale["u"]["mean"])) / scale["u"]["std"],
            "pitch_rad": (pitch_rad - pitch["mean_rad"]) / pitch["std_rad"],
            "proposals": proposals,
        }
        return np.concatenate([np.ravel(parts[name.split()[0]]) for name in scale["order"]])

    def observe_parts(self, **samples):
        """Return the observation vector of a task made of terms, of its parts (samples, width)."""
        scaled = []
        for part in self.contract["observation"]["parts"]:
            scaled.append(np.ravel((samples[part["name"]] - part["mean"]) / part["std"]))
        return np.concatenate(scaled)

    def command(self, observation):
        """Return the command, (J,), in the order of `joints`: a share of the full valve opening."""
        batch = observation[None].astype(np.float32)
        return self.session.run(None, {"observation": batch})[0][0]

    def find_end(self, target_m, q, time_s, pitch_rad=np.pi / 2):
        """Return why the episode ends now, or `None` while it goes on."""
        stop, limits = self.contract["stop"], self.contract["limits"]
        margin = stop["joint_margin"]
        margin = -np.inf if margin is None else margin
        if (q < np.add(limits["lower"], margin)).any() or (
            q > np.subtract(limits["upper"], margin)
        ).any():
            return "joint limit"
        tip_m, tip_pitch_rad = self.locate_tip(q)
        bearing = target_m[:2] / np.hypot(*target_m[:2])
        wanted_axis = np.append(np.cos(pitch_rad) * bearing, -np.sin(pitch_rad))
        past_m = tip_m - target_m
        depth_m = past_m @ wanted_axis
        measured = {
            "least_depth_below_target_m": depth_m,
            "largest_lateral_m": np.linalg.norm(past_m - depth_m * wanted_axis),
            "largest_distance_m": np.linalg.norm(past_m),
            "largest_pitch_error_rad": abs(pitch_rad - tip_pitch_rad),
        }
        reached = []
        for name, bound in stop["success"].items():
            least = name.startswith("least")
            reached.append(measured[name] >= bound if least else measured[name] <= bound)
        if all(reached):
            return "success"
        return "time" if time_s >= stop["time_s"] else None

    def locate_tip(self, q):
        """Return the tool point in the base frame, (3,), and its angle below the horizontal."""
        place, turn, heading = np.zeros(3), np.eye(3), None
        for link, position in zip(self.contract["kinematics"]["links"], q, strict=True):
            place, axis = place + turn @ link["origin_m"], np.array(link["axis"])
            if link["kind"] == "slide":
                place = place + turn @ (axis * position)
            else:
                cross = np.cross(np.eye(3), axis)  # Rodrigues' formula
                about = np.sin(position) * cross + (1 - np.cos(position)) * cross @ cross
                turn = turn @ (np.eye(3) + about)
            heading = turn[:2, 0] if heading is None else heading  # of the arm's plane
        tool = turn @ self.contract["kinematics"]["tool_m"]
        return place + tool, np.arctan2(-tool[2], tool[:2] @ heading)


def compare_with_golden_answers(folder):
    """Return the largest difference of a command to those that the training run recorded."""
    policy, golden = ExportedPolicy(folder), json.loads((Path(folder) / "golden.json").read_text())
    inputs, found = golden["inputs"], []
    for i in range(len(golden["command"])):
        one = {name: np.array(values[i]) for name, values in inputs.items()}
        has_parts = "parts" in policy.contract["observation"]
        observe = policy.observe_parts if has_parts else policy.observe
        target = [] if has_parts else [one.pop("target_in_base_m")]
        found.append(policy.command(observe(*target, **one)))
    return np.abs(np.array(found) - golden["command"]).max()


if __name__ == "__main__":
    print(f"largest difference of a command: {compare_with_golden_answers(sys.argv[1]):.1e}")
