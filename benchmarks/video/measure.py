"""Latency of the live video, read from its pictures: [chrt -r 1] python benchmarks/video/measure.py [out.json] [case …]

The page's server and the video process run in one network namespace, a headless Chromium in another
one, and `link.py` carries the packets between them. Each test picture bears the time of its making.
The browser reads it from the pixels of the picture that it is about to show, and notes the moment
at which that will be on the screen. So the latency holds everything from the making of the picture
to the screen, without exposure and transfer of a real camera, and without the screen's own delay.
Both processes share the computer's monotonic clock; the browser's is compared with it to half a
round trip. It needs root, for the namespaces.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))
sys.path.insert(0, str(Path(__file__).parent))

from browser import CHROMIUM, FLAGS
from link import ADDRESSES, DESK, SITE, EmulatedLink, LinkQuality, open_link

SECONDS, WARM_S = 30.0, 10.0
SIZE = {"width": 1366, "height": 900}
CHANGES_S = (20.0, 40.0, 60.0)
"""Times at which the link of the case `drop` gets bad, gets good, and ends."""
READ = """() => {
  const { video } = window.measured;
  window.read = video.cameras.map(camera => {
    const pictures = [], canvas = document.createElement("canvas");
    const context = canvas.getContext("2d", { willReadFrequently: true });
    const read = (now, { expectedDisplayTime, receiveTime, processingDuration, rtpTimestamp, width, height }) => {
      // Blocks of a sixteenth of the height, eight in a row; 32 bits of ms and 8 of a check.
      const side = Math.floor(height / 16);
      [canvas.width, canvas.height] = [8 * side, 5 * side];
      context.drawImage(camera.video, 0, 0, 8 * side, 5 * side, 0, 0, 8 * side, 5 * side);
      const { data } = context.getImageData(0, 0, 8 * side, 5 * side), bytes = [0, 0, 0, 0, 0];
      for (let place = 0; place < 40; place++) {
        const x = (place % 8 + 0.5) * side, y = (Math.floor(place / 8) + 0.5) * side;
        bytes[place >> 3] = bytes[place >> 3] << 1 | (data[4 * (Math.floor(y) * 8 * side + Math.floor(x))] > 127);
      }
      const right = (~(bytes[0] + bytes[1] + bytes[2] + bytes[3]) & 255) === bytes[4];
      const code_ms = right ? ((bytes[0] * 256 + bytes[1]) * 256 + bytes[2]) * 256 + bytes[3] : null;
      const taken_s = camera.taken.get(rtpTimestamp);
      const told_ms = taken_s === undefined ? null : expectedDisplayTime - 1e3 * taken_s - video.ahead_ms;
      pictures.push([now, expectedDisplayTime, receiveTime, processingDuration, code_ms, told_ms]);
      camera.video.requestVideoFrameCallback(read);
    };
    camera.video.requestVideoFrameCallback(read);
    return pictures;
  });
}"""
"""Notes each picture of each camera until `TAKE` takes the notes."""
TAKE = "() => window.read.map(pictures => pictures.splice(0))"
STATS = """async () => [...(await window.measured.video.peer.getStats()).values()].filter(one => one.type === "inbound-rtp")"""
COUNTED = ("packetsReceived", "packetsLost", "bytesReceived", "framesDecoded", "keyFramesDecoded")
COUNTED += ("framesDropped", "nackCount", "pliCount", "freezeCount", "retransmittedPacketsReceived")
GOOD = LinkQuality(rate_mbit_s=1000.0, delay_s=0.0, jitter_s=0.0, loss=0.0, in_order=True)
RADIO = LinkQuality(rate_mbit_s=20.0, delay_s=0.06, jitter_s=0.02, loss=0.01, in_order=True)
OVERTAKING = LinkQuality(rate_mbit_s=20.0, delay_s=0.06, jitter_s=0.02, loss=0.01, in_order=False)
BAD = LinkQuality(rate_mbit_s=1.0, delay_s=0.06, jitter_s=0.02, loss=0.01, in_order=True)
CASES = {
    "same_computer": (None, True),
    "cable": (GOOD, True),
    "radio": (RADIO, True),
    "radio_overtaking": (OVERTAKING, True),
    "drop": (RADIO, False),
}
"""Link, `None` for the loopback, and whether the page shows point clouds too."""
ORDER = ("same_computer", "cable", "radio", "radio", "radio", "radio_overtaking", "drop")
"""Cases of a whole run; the estimate of the link differs most where it is noisy."""


def find_offset_ms(page: Any) -> tuple[float, float]:
    """Return the monotonic clock less the page's, and half the shortest round trip."""
    best = (np.inf, 0.0)
    for _ in range(50):
        before_s = time.monotonic()
        at_ms = page.evaluate("performance.now()")
        way_s = time.monotonic() - before_s
        best = min(best, (way_s, 1e3 * (before_s + way_s / 2) - at_ms))
    return best[1], 500.0 * best[0]


def summarise(pictures: list[list[Any]], offset_ms: float, seconds: float) -> dict[str, Any]:
    """Return rate, latency and gaps of one camera's pictures."""
    if len(pictures) < 2:
        return {"pictures_s": round(len(pictures) / seconds, 1)}
    shown_ms = np.array([one[1] for one in pictures]) + offset_ms
    latency_ms, told_ms, received_ms = [], [], []
    for at_ms, (_, _, received, _, code_ms, told) in zip(shown_ms, pictures, strict=True):
        if code_ms is None:
            continue
        latency_ms.append((at_ms - code_ms) % 2**32)
        # A picture may arrive before it was taken, by the error of the clocks.
        since_ms = received + offset_ms - code_ms if received else np.nan
        received_ms.append((since_ms + 1e3) % 2**32 - 1e3)
        told_ms.append(np.nan if told is None else told)
    gaps_ms = np.diff(shown_ms)

    def quantiles(values: list[float]) -> dict[str, float]:
        return {
            name: round(float(np.nanquantile(values, part)), 1)
            for name, part in {"p50": 0.5, "p95": 0.95, "max": 1.0}.items()
        }

    return {
        "pictures_s": round(len(pictures) / seconds, 1),
        "unreadable": sum(one[4] is None for one in pictures),
        "latency_ms": quantiles(latency_ms),
        "of_it_until_received_ms": quantiles(received_ms),
        "shown_on_the_page_ms": quantiles(told_ms),
        "longest_gap_ms": round(float(gaps_ms.max()), 1),
        "gaps_over_300_ms": int((gaps_ms > 300).sum()),
    }


def count(page: Any) -> list[dict[str, float]]:
    return [{name: one.get(name, 0) for name in COUNTED} for one in page.evaluate(STATS)]


def watch(page: Any, seconds: float, offset_ms: float) -> dict[str, Any]:
    """Return what the page shows for some seconds."""
    page.evaluate(TAKE)
    begun_s, before, counted = (
        time.monotonic(),
        page.evaluate("window.measured.frames"),
        count(page),
    )
    page.wait_for_timeout(1e3 * seconds)
    took_s, pictures, after = time.monotonic() - begun_s, page.evaluate(TAKE), count(page)
    names = page.evaluate("window.measured.video.cameras.map(one => one.name)")
    cameras = {}
    for name, seen, first, last in zip(names, pictures, counted, after, strict=True):
        change = {key: last[key] - first[key] for key in COUNTED}
        cameras[name] = {
            **summarise(seen, offset_ms, took_s),
            "mbit_s": round(8e-6 * change.pop("bytesReceived") / took_s, 2),
            **change,
        }
    frames = page.evaluate("window.measured.frames") - before
    return {
        "seconds": round(took_s, 1),
        "point_clouds_s": round(frames / took_s, 2),
        "cameras": cameras,
    }


def drive(case: str, url: str, quality_pipe: str) -> None:
    """Run the browser's side, in its own namespace; write the result as JSON to stdout."""
    from playwright.sync_api import sync_playwright

    points = CASES[case][1]
    with sync_playwright() as play:
        browser = play.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        page = browser.new_context(viewport=SIZE).new_page()
        if not points:
            page.route("**/scene.js", lambda route: route.fulfill(content_type="text/javascript"))
        page.goto(url)
        shown = "window.measured?.video?.cameras.filter(one => one.shown).length"
        while page.evaluate(shown) != 2:
            page.wait_for_timeout(200)
        page.wait_for_timeout(1e3 * WARM_S)
        page.evaluate(READ)
        offset_ms, error_ms = find_offset_ms(page)
        result: dict[str, Any] = {"clock_error_ms": round(error_ms, 2)}
        if case == "drop":
            parts, before_s = {}, 0.0
            for name, until_s in zip(("before", "bad", "after"), CHANGES_S, strict=True):
                # The first seconds after a change, and the rest.
                Path(quality_pipe).write_text(name)
                for part, seconds in (("begin", 5.0), ("rest", until_s - before_s - 5.0)):
                    parts[f"{name}_{part}"] = watch(page, seconds, offset_ms)
                before_s = until_s
            result |= {"parts": parts}
        else:
            result |= watch(page, SECONDS, offset_ms)
        result |= {"browser": f"Chromium {browser.version}, headless"}
        browser.close()
    sys.stdout.write(json.dumps(result))


def run_case(case: str, folder: Path) -> dict[str, Any]:
    """Run one case: server, link and browser."""
    quality, _ = CASES[case]
    out, told = folder / case, folder / f"{case}.quality"
    host = "127.0.0.1" if quality is None else ADDRESSES[SITE]
    command = [sys.executable, "-m", "brokk_rl", "mode=page", "page=network", f"page.host={host}"]
    command += [f"page.names=[{host}]", "page.port=18170", "page.frames_hz=3", "video=pattern"]
    command += [f"video.host={host}", f"session.out={out}"]
    with open_link(quality) if quality else nullcontext() as link:
        inside = {one: ["ip", "netns", "exec", one] if link else [] for one in (SITE, DESK)}
        server = subprocess.Popen([*inside[SITE], *command], stderr=subprocess.DEVNULL)
        try:
            while not (out / "page.url").exists():
                time.sleep(0.1)
            url = (out / "page.url").read_text().strip()
            driver = subprocess.Popen(
                [*inside[DESK], sys.executable, __file__, "--drive", case, url, str(told)],
                stdout=subprocess.PIPE,
            )
            while driver.poll() is None:
                time.sleep(0.02)
                if isinstance(link, EmulatedLink) and told.exists():
                    link.quality = BAD if told.read_text() == "bad" else RADIO
            assert driver.stdout is not None
            result = json.loads(driver.stdout.read())
        finally:
            server.terminate()
            server.wait()
        # vars() of a dataclass is its fields
        facts = {"case": case, "link": vars(quality) if quality else None}
        return (
            facts
            | {"load": round(os.getloadavg()[0], 1)}
            | result
            | {"packets": link.counts if isinstance(link, EmulatedLink) else None}
        )


def main() -> None:
    if sys.argv[1:2] == ["--drive"]:
        drive(*sys.argv[2:5])
        return
    import tempfile

    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for number, case in enumerate(sys.argv[2:] or ORDER):
            place = Path(folder) / str(number)
            place.mkdir()
            rows.append(run_case(case, place))
            sys.stderr.write(json.dumps(rows[-1]) + "\n")
    commit = subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True
    ).stdout.strip()
    facts = {
        "command": "chrt -r 1 python benchmarks/video/measure.py benchmarks/video/video.json",
        "commit": commit,
        "cores": os.cpu_count(),
        "kernel": os.uname().release,
        "flags": FLAGS,
        "window": SIZE,
        "video": "video=pattern: two cameras, 640 x 360, 15 Hz; point clouds of mode=page at 3 Hz",
    }
    text = json.dumps(facts | {"rows": rows}, indent=1) + "\n"
    if len(sys.argv) > 1:
        Path(sys.argv[1]).write_text(text)


if __name__ == "__main__":
    main()
