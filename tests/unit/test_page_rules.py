"""Who may ask the page's server for what, how frames are coded, whose clock it was."""

from __future__ import annotations

import inspect
import json
import math
import re
import zlib
from dataclasses import replace
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
from browser import SHOWN, TOKEN, change_state
from composed import MACHINE
from conftest import Note
from hypothesis import given
from hypothesis import strategies as st

from brokk_rl.errors import FrameError, StorageError
from brokk_rl.kinematics import compute_tool_kinematics
from brokk_rl.machine import JointPart
from brokk_rl.session import Session
from brokk_rl.signals import Frame
from deploy.kernel.guard import GuardState, GuardTrip
from deploy.page import access, alarms, frame_codec
from deploy.page.connections import Places
from deploy.page.files import load_files
from deploy.page.protocol import (
    BoreholeChoice,
    OperatorRequest,
    PageState,
    RecordingStatus,
    SourceAge,
)
from deploy.page.scene import measure_insertion, plan_approach
from deploy.page.server import write_link

MINE = access.list_own_names("127.0.0.1", ())


@pytest.mark.parametrize(
    "host", ["localhost:8170", "127.0.0.1:8170", "[::1]:8170", "localhost:19000", "localhost"]
)
def test_a_page_of_this_server_may_connect_through_a_forwarded_port_too(
    host: str, record_property: Note
) -> None:
    record_property("page: through a forwarded port; answer", "opens")
    assert access.is_same_origin(f"http://{host}", host, MINE)


@pytest.mark.parametrize(
    ("origin", "host"),
    [
        ("http://evil.example", "localhost:8170"),
        ("http://localhost:9999", "localhost:8170"),
        ("https://localhost:8170", "localhost:8170"),
        ("http://127.0.0.1:8170", "localhost:8170"),
        ("null", "localhost:8170"),
        # DNS rebinding: its own origin, but not our name
        ("http://evil.example:8170", "evil.example:8170"),
        (None, "evil.example:8170"),
        (None, "localhost:8170:80"),
        (None, "localhost:"),
        (None, "evil.example:localhost"),
        (None, None),
    ],
)
def test_nobody_else_may(origin: str | None, host: str | None) -> None:
    assert not access.is_same_origin(origin, host, MINE)


def test_in_a_network_the_names_are_those_of_the_configuration() -> None:
    names = access.list_own_names("0.0.0.0", ("site.lan",))
    assert access.is_own_host("site.lan:80", names)
    assert not access.is_own_host("evil.example:80", names)


def test_only_the_whole_token_fits() -> None:
    assert access.compare_tokens(TOKEN, TOKEN)
    for shown in (None, 7, "", TOKEN[:-1], TOKEN + " ", [TOKEN], "ключ", "\ud800"):
        assert not access.compare_tokens(shown, TOKEN)


@given(
    st.text(max_size=300)
    | st.recursive(
        st.none() | st.floats() | st.text(), lambda v: st.lists(v) | st.dictionaries(st.text(), v)
    ).map(json.dumps)
)
def test_nonsense_is_no_wish_and_no_error(text: str) -> None:
    assert access.parse_request(text) is None


@pytest.mark.parametrize(
    "found",
    [
        {"kind": "arm", "value": ""},
        {"kind": "record", "value": "maybe"},
        {"kind": "stop", "value": "x"},
        {"kind": "stop"},
        {"kind": ["stop"], "value": ""},
        {"kind": "target", "value": "A" * 300},
        {"kind": "target", "value": ""},
        {"kind": "stop", "value": "", "token": "x"},
    ],
)
def test_a_wish_that_is_not_quite_one_is_none(found: dict[str, object]) -> None:
    assert access.parse_request(json.dumps(found)) is None


def test_without_the_dead_man_only_stop_goes_through() -> None:
    released = change_state(SHOWN, deadman=False)
    stopped = change_state(SHOWN, estop=True)
    old = replace(SHOWN, streams=(SourceAge("levers", 0.2, 0.15),))
    dead, unknown = replace(SHOWN, alive=False), replace(SHOWN, state=None)
    for shown in (released, stopped, old, dead, unknown):
        for wish in (
            OperatorRequest("start", ""),
            OperatorRequest("record", "on"),
            OperatorRequest("record", "off"),
            OperatorRequest("target", "A"),
        ):
            assert access.find_refusal(wish, shown) == "deadman"
        assert access.find_refusal(OperatorRequest("stop", ""), shown) is None
    assert access.find_refusal(OperatorRequest("start", ""), SHOWN) is None
    assert access.find_refusal(OperatorRequest("target", "B"), SHOWN) is None
    assert access.find_refusal(OperatorRequest("target", "C"), SHOWN) == "target"


def frame(height: int, width: int) -> Frame:
    chance = np.random.default_rng(3)
    depth_m = chance.uniform(0.3, 9.0, (height, width)).astype(np.float32)
    depth_m[chance.random((height, width)) < 0.2] = np.nan
    color = np.full((height, width, 3), (200, 30, 60), np.uint8)
    matrix = np.array([[400.0, 0, 50.0], [0, 410.0, 30.0], [0, 0, 1]])
    return Frame(color, depth_m, matrix, np.eye(4), 4.5)


def decode_depth_m(data: bytes, width: int, height: int) -> np.ndarray:
    """Return the depths that `data` holds, `(h, w)` float32 in m, NaN where unknown."""
    planes = np.frombuffer(zlib.decompress(data), np.uint8)
    low, high = planes.reshape(2, height, width).astype(np.uint16)
    outwards = low | high << 8
    units = ((outwards >> 1) ^ -(outwards & 1)).cumsum(1, dtype=np.uint16).astype(np.float32)
    return np.where(units > 0, units * np.float32(frame_codec.M_PER_UNIT), np.float32(np.nan))


def test_depth_comes_back_to_the_millimetre_and_unknown_stays_unknown() -> None:
    sent = frame(17, 33)
    message = frame_codec.encode_frame(sent, 640, 90)
    length = int.from_bytes(message[:4], "little")
    header = json.loads(message[4 : 4 + length])
    planes = message[4 + length : 4 + length + header["depth_bytes"]]
    back_m = decode_depth_m(planes, header["width"], header["height"])
    np.testing.assert_array_equal(np.isnan(back_m), np.isnan(sent.depth_m))
    assert np.nanmax(np.abs(back_m - sent.depth_m)) <= 0.00051
    assert (header["focal_px"], header["center_px"]) == ([400.0, 410.0], [50.0, 30.0])
    assert header["t_s"] == 4.5


def test_a_frame_is_shrunk_and_its_camera_with_it() -> None:
    message = frame_codec.encode_frame(frame(40, 80), 40, 80)
    header = json.loads(message[4 : 4 + int.from_bytes(message[:4], "little")])
    assert (header["width"], header["height"], header["focal_px"]) == (40, 20, [200.0, 205.0])


def test_what_is_too_far_or_infinite_is_unknown() -> None:
    depth_m = np.array([[np.inf, 70.0, -1.0, 0.5, np.nan]], np.float32)
    low, high = frame_codec.encode_depth_planes(depth_m).astype(int)
    # 0 mm, 0, 0, then 500 up and 500 down
    assert (low + 256 * high).tolist() == [[0, 0, 0, 1000, 999]]


def test_depth_and_colour_of_different_sizes_are_refused() -> None:
    other = replace(frame(16, 32), depth_m=np.ones((8, 8), np.float32))
    with pytest.raises(FrameError, match="expected one size"):
        frame_codec.encode_frame(other, 640, 80)


def test_the_way_leads_over_the_rim_and_then_down_the_axis() -> None:
    center_m, up = np.array([2.0, 0.0, 0.5]), np.array([0.0, 0.0, 1.0])
    aside = plan_approach(np.array([1.0, 1.0, 1.0]), center_m, up)
    assert np.allclose(aside, [(1, 1, 1), (2, 0, 0.8), (2, 0, 0.4)])
    above = plan_approach(np.array([2.0, 0.01, 0.6]), center_m, up)
    assert np.allclose(above, [(2.0, 0.01, 0.6), (2, 0, 0.4)])


def test_the_tool_is_measured_along_and_across_the_axis_of_the_hole() -> None:
    # q2 + q3 + q4 + q5 = pi/2 points the chisel straight down; the slew turns the view with it
    q = np.array([0.4, -0.9, 0.6, 1.2, np.pi / 2 - 0.9])
    tool = compute_tool_kinematics(MACHINE, q)
    ahead, left = np.array([np.cos(0.4), np.sin(0.4), 0]), np.array([-np.sin(0.4), np.cos(0.4), 0])
    rim_m = tool.tip_in_base_m + 0.02 * ahead - 0.01 * left + np.array([0, 0, 0.12])
    up = (0.0, 0.0, 1.0)
    hole = BoreholeChoice("1", tuple(rim_m), up, 0.05, None, None, True)
    found = measure_insertion(tool, hole)
    assert found.depth_m == pytest.approx(0.12)
    assert found.lateral_m == pytest.approx(math.hypot(0.02, 0.01))
    assert found.angle_rad == pytest.approx(0.0, abs=1e-6)
    assert found.inserted
    assert found.center_in_view_m == pytest.approx((0.01, 0.02, -0.12)), "right, up, ahead"
    assert found.axis_in_view == pytest.approx((0.0, 0.0, -1.0), abs=1e-9)
    # leaning outwards by 0.1 rad about the tip: the hole's axis then leans towards the machine
    leaning = measure_insertion(compute_tool_kinematics(MACHINE, q - [0, 0, 0, 0, 0.1]), hole)
    assert leaning.angle_rad == pytest.approx(0.1)
    assert leaning.axis_in_view[1] == pytest.approx(math.sin(0.1))
    beside = replace(hole, radius_m=0.02)
    assert not measure_insertion(tool, beside).inserted, "beside a hole is not in it"
    shallow = replace(hole, center_in_base_m=tuple(rim_m - [0, 0, 0.03]))
    assert not measure_insertion(tool, shallow).inserted


def list_names(shown: PageState) -> list[str]:
    return [f"{one.level} {one.name} {one.detail}".strip() for one in alarms.list_alarms(shown)]


ON = RecordingStatus(on=True, seconds=3.0, dropped=0, failed=False)
STREAMS = (SourceAge("borehole", 700.0, 600.0), SourceAge("camera", 3.0, 1.0))
NEVER = (SourceAge("positions", None, 0.1), SourceAge("camera", None, 1.0))
LATCHED = {"guard": GuardState.LATCHED, "cause": GuardTrip.JOINT_STILL, "observed_joint": 3}
ALARMS: list[tuple[PageState, list[str]]] = [
    (SHOWN, []),
    (replace(SHOWN, alive=False), ["alarm control computer silent"]),
    (replace(SHOWN, streams=(*SHOWN.streams[:2], *STREAMS)), ["alarm too old camera", "caution too old borehole"]),
    (replace(SHOWN, streams=NEVER), ["alarm nothing has come positions", "caution nothing has come camera"]),
    (replace(SHOWN, health=replace(SHOWN.health, delay_s=0.07)), []),
    (replace(SHOWN, health=replace(SHOWN.health, delay_s=0.08)), ["caution messages arrive late 80 ms"]),
    (replace(SHOWN, health=replace(SHOWN.health, delay_s=0.2)), ["alarm messages arrive late 200 ms"]),
    (replace(SHOWN, recording=ON), []),
    (replace(SHOWN, recording=ON, health=replace(SHOWN.health, log_behind=True)), ["alarm recorder does not write"]),
    (replace(SHOWN, recording=replace(ON, dropped=4)), ["alarm recording has gaps 4"]),
    (replace(SHOWN, recording=replace(ON, on=False, failed=True)), ["alarm recording failed"]),
    (replace(SHOWN, health=replace(SHOWN.health, supervisor_silent=True)), ["alarm supervisor silent"]),
    (change_state(SHOWN, guard=GuardState.SILENT, trip=GuardTrip.LEVER), []),
    *((change_state(SHOWN, guard=GuardState.SILENT, trip=trip, observed_joint=3), [f"alarm {trip.value} joint 3"])
      for trip in (GuardTrip.JOINT_DRIFTS, GuardTrip.FLOW_UNASKED)),
    (change_state(SHOWN, target=GuardTrip.TARGET_REACH), ["alarm borehole out of reach"]),
    (change_state(SHOWN, prompt=True), ["alarm are you there"]),
    (change_state(SHOWN, **LATCHED), [f"alarm {GuardTrip.JOINT_STILL.value} joint 3"]),
    (change_state(SHOWN, estop=True, guard=GuardState.LATCHED, cause=GuardTrip.ESTOP), ["alarm emergency stop"]),
]  # fmt: skip


@pytest.mark.parametrize(("shown", "names"), ALARMS)
def test_alarms_name_what_has_failed_and_nothing_else(shown: PageState, names: list[str]) -> None:
    assert list_names(shown) == names


@pytest.mark.parametrize("before", ["link", "open", "none"])
def test_the_link_with_the_token_is_its_owners_alone(
    tmp_path: Path, before: str, record_property: Note
) -> None:
    path, other = tmp_path / "page.url", tmp_path / "other"
    (tmp_path / "run/page.url").mkdir(parents=True)
    with pytest.raises(StorageError, match="remove it"):
        write_link(Session(out=str(tmp_path / "run"), seed=0, device="cpu"), "http://x")
    other.write_text("another's")
    if before == "link":
        path.symlink_to(other)
    elif before == "open":
        path.write_text("old")
        path.chmod(0o666)
    write_link(Session(out=str(tmp_path), seed=0, device="cpu"), "http://localhost/#token=x")
    mode = f"{path.stat().st_mode & 0o777:o}"
    record_property("page: page.url was a link, or of mode 666; mode", mode)
    assert path.read_text() == "http://localhost/#token=x\n" and not path.is_symlink()
    assert path.stat().st_mode & 0o777 == 0o600 and other.read_text() == "another's"


def test_both_languages_say_everything() -> None:
    text = load_files(b"")["/words.js"][1].decode()
    german, english = text.split("const EN")
    keys = {
        name: set(re.findall(r'(?:^|[{,]\s*)"?([\w\- ,\']+?)"?:\s*"', part, re.M))
        for name, part in (("de", german), ("en", english))
    }
    assert keys["en"] <= keys["de"]
    from deploy.runtime.operator_state import AdviceStatus

    said = {one.value for one in (*GuardTrip, *AdviceStatus)} - {"valid"}
    rules = inspect.getsource(alarms)
    said |= set(re.findall(r'Alarm\((?:"\w+"|.+?), "([^"]+)"', rules)) | set(get_args(JointPart))
    assert said - {key for key in said if f'"{key}":' in german or f" {key}:" in german} == set()


def test_places_are_kept_apart_and_the_mute_and_the_oldest_give_way() -> None:
    places = Places[str](2, mute_s=2.0)
    assert places.admit("a", 0.0) == (True, None)
    assert places.admit("b", 0.5) == (True, None)
    assert places.admit("c", 1.9) == (False, None), "nobody has been mute for two seconds"
    places.note_heard("a", 1.9)
    assert places.admit("c", 2.5) == (True, "b")
    places.note_heard("b", 2.6)
    assert len(places) == 2
    places.release("a")
    assert places.admit("d", 2.5) == (True, None)
    open_ones = Places[str](3)
    gone = [open_ones.admit(name, t_s)[1] for t_s, name in enumerate("wxyz")]
    assert gone == [None, None, None, "w"]
