"""The report in a real browser, without a network: it draws, turns, plays, and says no error."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from modetune.core.storage.record import CampaignRecord
from modetune.flows.report.page import write_page

#: WebGL without a graphics card.
ARGUMENTS = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
#: Sum of the heights of the model's vertices as they are drawn now.
HEIGHTS = "document.getElementById('shape-view').data[0].z.reduce((a, b) => a + b, 0)"
READY = "document.getElementById('shape-view').dataset.ready === 'true'"
EYE = (
    "Object.values(document.getElementById('shape-view')._fullLayout.scene._scene.getCamera().eye)"
)
PATIENCE_MS = 60_000


class Opened:
    """A page, what it asked for, and what it complained of."""

    def __init__(self, page: Any) -> None:
        self.page = page
        self.requests: list[str] = []
        self.complaints: list[str] = []
        page.set_default_timeout(PATIENCE_MS)
        page.on("request", lambda request: self.requests.append(request.url))
        page.on("pageerror", lambda error: self.complaints.append(str(error)))
        page.on("console", self._console)

    def _console(self, message: Any) -> None:
        if message.type == "error":
            self.complaints.append(message.text)

    def value(self, expression: str) -> Any:
        return self.page.evaluate(expression)

    def wait(self, condition: str) -> None:
        """Until a condition holds, looked at once a frame; the page's policy forbids `eval`."""
        self.page.evaluate(
            f"""new Promise((done, failed) => {{
                const end = performance.now() + {PATIENCE_MS};
                const look = () => {{
                    if ({condition}) done(true);
                    else if (performance.now() > end) failed(new Error("it does not come about"));
                    else requestAnimationFrame(look);
                }};
                look();
            }})"""
        )

    def frames(self, count: int) -> None:
        """Until the browser has drawn so often."""
        self.page.evaluate(
            f"""new Promise((done) => {{
                let left = {count};
                const next = () => (left-- > 0 ? requestAnimationFrame(next) : done(true));
                next();
            }})"""
        )

    def to_shapes(self) -> None:
        self.page.locator("#shape-view").scroll_into_view_if_needed()
        self.wait(READY)


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    program = shutil.which("chromium")
    if program is None:
        pytest.skip("there is no chromium on PATH")
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    with playwright.sync_playwright() as started:
        browser = started.chromium.launch(executable_path=program, args=ARGUMENTS)
        yield browser
        browser.close()


@pytest.fixture
def opened(browser: Any, record: CampaignRecord, tmp_path: Path) -> Iterator[Opened]:
    file = write_page(record, tmp_path / "report.html")
    page = browser.new_page(viewport={"width": 1200, "height": 800})
    opened = Opened(page)
    page.goto(file.as_uri())
    yield opened
    page.close()


def test_all_of_it_is_drawn_without_an_error_and_without_a_request(opened: Opened) -> None:
    opened.to_shapes()
    opened.value("modetune.drawAll().then(() => true)")
    drawn = opened.value(
        "[...document.querySelectorAll('[data-chart]')].map("
        "(one) => [one.dataset.chart, one.querySelector('svg, canvas') !== null])"
    )
    assert [name for name, there in drawn if not there] == []
    assert {name for name, _ in drawn} >= {
        "frequencies",
        "mac-before",
        "mac_map",
        "comac-after",
        "parameters",
        "sensitivities",
        "convergence",
    }
    assert opened.complaints == []
    assert len(opened.requests) == 1
    assert opened.requests[0].startswith("file://")


def test_another_mode_and_another_state_have_another_shape(opened: Opened) -> None:
    opened.to_shapes()
    # Half a wave each way stays above the plane: its heights add up; two half waves cancel out.
    first = opened.value(HEIGHTS)
    assert abs(first) > 1.0
    assert "test 10.000 Hz, model 10.010 Hz (+0.10 %)" in opened.page.inner_text("#shape-told")
    opened.page.select_option("#shape-mode", "1")
    opened.wait(f"Math.abs({HEIGHTS}) < 1e-3 * {abs(first)}")
    opened.page.click("button[data-state=before]")
    assert "model 23.100 Hz (+5.00 %)" in opened.page.inner_text("#shape-told")
    assert opened.complaints == []


def test_play_moves_the_model_and_pause_stops_it(opened: Opened) -> None:
    opened.to_shapes()
    first = opened.value(HEIGHTS)
    opened.page.click("#shape-play")
    opened.wait(f"Math.abs({HEIGHTS} - {first}) > 0.2 * {abs(first)}")
    assert opened.page.inner_text("#shape-play") == "Pause"
    opened.page.click("#shape-play")
    opened.frames(3)
    stopped = opened.value(HEIGHTS)
    opened.frames(3)
    assert opened.value(HEIGHTS) == stopped
    assert opened.complaints == []


def test_the_amplitude_scales_the_shape(opened: Opened) -> None:
    opened.to_shapes()
    first = opened.value(HEIGHTS)
    opened.page.locator("#shape-amplitude").fill("200")
    opened.wait(f"Math.abs({HEIGHTS} - {2 * first}) < 1e-3 * {abs(first)}")
    opened.page.locator("#shape-amplitude").fill("0")
    opened.wait(f"Math.abs({HEIGHTS}) < 1e-3")


def test_the_shape_turns_with_the_mouse_while_it_moves(opened: Opened) -> None:
    opened.to_shapes()
    opened.page.click("#shape-play")
    before = opened.value(EYE)
    box = opened.page.locator("#shape-view").bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    mouse = opened.page.mouse
    mouse.move(x, y)
    mouse.down()
    for share in range(1, 6):
        mouse.move(x + 20 * share, y + 8 * share)
        opened.frames(2)  # the drawing looks at the mouse once in each
    mouse.up()
    opened.wait(f"Math.hypot(...{EYE}.map((v, k) => v - {before}[k])) > 0.05")
    assert opened.complaints == []
