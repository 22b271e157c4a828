"""How fast the page is, in a headless Chromium: [chrt -r 1] python benchmarks/page/measure.py [out.json]

Advice at 20 Hz and levers at 50 Hz as from the loop, frames of 640 x 360 px at 3 and at 10 Hz, the
3D scene beside them. Latency is from the moment an advice stands in the feed to the moment its
frame is through layout and paint, by the browser's clock, translated to ours to half the round
trip. Of it: on the way from the server to the page, and in the browser until drawn; the rest it
waited for the server to look. Frame rate and bytes are what the browser has drawn and received.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))

from browser import FLAGS, chromium, served
from composed import option

from brokk_rl.machine import Machine
from deploy.page import server
from deploy.page.clock import DrawAcknowledgement, PageClock
from deploy.page.demo import DemoFeed, DemoMachine
from deploy.page.frame_codec import encode_frame
from deploy.page.protocol import DrawReport

SECONDS, WARM_S = 10.0, 6.0
QUANTILES = {"p50": 0.5, "p95": 0.95, "max": 1.0}
SIZE = {"width": 1366, "height": 900}


class Timed(DemoFeed):
    """The demo, which remembers when it said what first and when that was seen."""

    def __init__(self, demo: DemoMachine, machine: Machine) -> None:
        super().__init__(demo, machine, time.monotonic)
        self.period_s = machine.period_s
        self.latency_s: list[tuple[float, float]] = []
        self.round_trip_s = np.inf

    def report_drawn(self, report: DrawReport) -> None:
        made_s = self._began_s + report.number * self.period_s
        self.latency_s.append((time.monotonic(), report.t_s - made_s))
        self.round_trip_s = min(self.round_trip_s, report.round_trip_s)


class Parted(PageClock):
    """The clock of a page, which also remembers where the time of an advice went: how long each lay in the browser until drawn."""

    in_browser_ms: ClassVar[list[float]] = []
    on_the_way_ms: ClassVar[list[float]] = []

    def read_acknowledgement(self, text: str | bytes, now_s: float) -> DrawAcknowledgement | None:
        number, came_ms, drawn_ms, _ = json.loads(text)
        sent_s = self._sent.get(number, (np.nan, None))[0]
        said = super().read_acknowledgement(text, now_s)
        if said is not None and said.advice is not None:
            self.in_browser_ms.append(drawn_ms - came_ms)
            self.on_the_way_ms.append(1e3 * (said.drawn_s - sent_s) - self.in_browser_ms[-1])
        return said


def compute_quantiles(values_ms: Any) -> dict[str, float]:
    return {name: round(float(np.quantile(values_ms, part)), 1) for name, part in QUANTILES.items()}


def measure(browser: Any, rate_hz: float, scene: bool) -> dict[str, Any]:
    demo = replace(option("feed", "demo"), rate_hz=rate_hz, frames=scene)
    machine = option("machine", "brokk170")
    feed = Timed(demo, machine)
    with served(feed, frames_hz=rate_hz) as port:
        context = browser.new_context(viewport=SIZE)
        page = context.new_page()
        if not scene:
            page.route(
                "**/scene.js", lambda route: route.fulfill(content_type="text/javascript", body="")
            )
        page.goto(f"http://localhost:{port}/")
        time.sleep(WARM_S)
        Parted.in_browser_ms.clear()
        Parted.on_the_way_ms.clear()
        begun_s, before = time.monotonic(), page.evaluate("window.measured")
        fps: list[float] = []
        while time.monotonic() - begun_s < SECONDS:
            page.wait_for_timeout(1000)
            fps.append(page.evaluate("window.measured.fps"))
        took_s, after = time.monotonic() - begun_s, page.evaluate("window.measured")
        bytes_a_frame = 0
        if scene:
            frame = feed.read_frame(-1.0)
            assert frame is not None
            bytes_a_frame = len(encode_frame(frame, 640, 80))
        context.close()
    latency_s = np.array([value for at_s, value in feed.latency_s if at_s > begun_s])
    frames_hz = (after["frames"] - before["frames"]) / took_s
    return {
        "frames_asked_hz": rate_hz if scene else 0.0,
        "scene": scene,
        "points": after["points"],
        "load": round(os.getloadavg()[0], 1),
        "lever_latency_ms": compute_quantiles(1e3 * latency_s),
        "of_it_on_the_way_ms": compute_quantiles(Parted.on_the_way_ms),
        "of_it_in_browser_ms": compute_quantiles(Parted.in_browser_ms),
        "clock_error_ms": round(500 * feed.round_trip_s, 2),
        "advices_drawn_share": round(len(latency_s) * machine.period_s / took_s, 3),
        "page_drawn_hz": round((after["drawn"] - before["drawn"]) / took_s, 1),
        "scene_fps": round(float(np.median(fps)), 1),
        "frames_drawn_hz": round(frames_hz, 2),
        "frame_to_drawn_ms": round(after["frame_ms"], 1),
        "frame_kib": round(bytes_a_frame / 1024),
        "mbit_s": round(8e-6 * bytes_a_frame * rate_hz, 2),
    }


def main() -> None:
    server.PageClock = Parted
    with chromium() as browser:
        rows = []
        for rate_hz, scene in ((3.0, False), (3.0, True), (10.0, True)):
            rows.append(measure(browser, rate_hz, scene))
            sys.stdout.write(json.dumps(rows[-1]) + "\n")
        facts = {
            "browser": f"Chromium {browser.version}, headless",
            "flags": FLAGS,
            "cores": os.cpu_count(),
            "scheduler": {os.SCHED_OTHER: "ordinary", os.SCHED_FIFO: "fifo", os.SCHED_RR: "rr"}.get(
                os.sched_getscheduler(0)
            ),
            "window": SIZE,
            "seconds": SECONDS,
        }
    commit = subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True
    ).stdout.strip()
    text = json.dumps(facts | {"seconds": SECONDS, "commit": commit, "rows": rows}, indent=1)
    if len(sys.argv) > 1:
        Path(sys.argv[1]).write_text(text + "\n")


if __name__ == "__main__":
    main()
