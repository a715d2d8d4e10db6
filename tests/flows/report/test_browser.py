"""The report in a real browser, without a network: it draws, turns, plays, and says no error."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image, ImageSequence

from modetune.core.modes import ModeSet, mode_set
from modetune.core.storage.campaign_record import CampaignRecord
from modetune.core.surface import Surface
from modetune.flows.report.page import write_page, write_study
from modetune.flows.report.tables import Column, Table

PLAYER = "modetune.player"
#: The layer that is the model's surface, and the sum of its vertices' motions in z as drawn now.
SURFACE = f"{PLAYER}.space.layers.find((one) => one.which === 0)"
HEIGHTS = (
    f"{PLAYER}.space.factor * {SURFACE}.motion.reduce((a, v, i) => a + (i % 3 === 2 ? v : 0), 0)"
)
READY = "document.getElementById('shape-view').dataset.ready === 'true'"
EYE = f"[{PLAYER}.space.azimuth, {PLAYER}.space.elevation]"
TOLD = "#shape-view .told"
#: Pixels of the shapes that are not paper, left and right of the middle.
INKED = f"""(() => {{
    const space = {PLAYER}.space, seen = space.pixels(400), found = [0, 0];
    const paper = space.paper.map((v) => Math.round(255 * v));
    for (let at = 0; at < seen.data.length; at += 4) {{
        if (paper.some((v, k) => Math.abs(seen.data[at + k] - v) > 12)) {{
            found[at / 4 % seen.width < 200 ? 0 : 1]++;
        }}
    }}
    return found;
}})()"""
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
        self.value("modetune.drawAll()")  # or charts that come into sight move what is below
        self.page.locator("#shape-view").scroll_into_view_if_needed()
        self.wait(READY)


Open = Callable[..., Opened]


@pytest.fixture
def open_page(browser: Any, tmp_path: Path) -> Iterator[Open]:
    """Opens the report of a record, as a context of the browser is told."""
    contexts = []

    def opening(record: CampaignRecord, width: int = 1200, **told: Any) -> Opened:
        file = write_page(record, tmp_path / "report.html")
        contexts.append(browser.new_context(viewport={"width": width, "height": 800}, **told))
        opened = Opened(contexts[-1].new_page())
        opened.page.goto(file.as_uri())
        return opened

    yield opening
    for context in contexts:
        context.close()


@pytest.fixture
def opened(open_page: Open, record: CampaignRecord) -> Opened:
    return open_page(record)


def test_charts_are_drawn_without_scrolling(opened: Opened) -> None:
    shown = "[...document.querySelectorAll('[data-chart]')].filter((one) => one.offsetParent)"
    opened.wait(f"{shown}.every((one) => one.querySelector('svg > g *') !== null)")
    opened.wait("document.querySelector('#comac-view canvas') !== null")
    assert opened.value(f"{shown}.length") > 5
    assert opened.value("window.scrollY") == 0


def test_all_of_it_is_drawn_without_an_error_and_without_a_request(opened: Opened) -> None:
    opened.to_shapes()
    opened.value("document.querySelectorAll('details').forEach((one) => { one.open = true; })")
    opened.value("modetune.drawAll()")
    drawn = opened.value(
        "[...document.querySelectorAll('[data-chart]')].map("
        "(one) => [one.dataset.chart, one.querySelector('svg > g *') !== null])"
    )
    assert [name for name, there in drawn if not there] == []
    assert {name for name, _ in drawn} >= {
        "frequencies",
        "mac",
        "mac_map",
        "comac",
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
    assert opened.page.inner_text(TOLD).startswith(
        "test mode 1: 10.000 Hz, model after (mode 1): 10.010 Hz (+0.10 %), MAC 1.000"
    )
    opened.page.select_option("select[aria-label='test mode']", "1")
    opened.wait(f"Math.abs({HEIGHTS}) < 1e-3 * {abs(first)}")
    opened.page.click("button[data-state=before]")
    assert "model before (mode 2): 23.100 Hz (+5.00 %)" in opened.page.inner_text(TOLD)
    assert opened.complaints == []


def test_play_moves_the_model_and_pause_stops_it(opened: Opened) -> None:
    opened.to_shapes()
    first = opened.value(HEIGHTS)
    opened.page.get_by_text("Play", exact=True).click()
    opened.wait(f"Math.abs({HEIGHTS} - {first}) > 0.2 * {abs(first)}")
    opened.page.get_by_text("Pause", exact=True).click()
    opened.frames(3)
    stopped = opened.value(HEIGHTS)
    opened.frames(3)
    assert opened.value(HEIGHTS) == stopped
    assert opened.complaints == []


def test_the_amplitude_scales_the_shape(opened: Opened) -> None:
    opened.to_shapes()
    first = opened.value(HEIGHTS)
    opened.page.locator("#shape-view input[type=range]").fill("200")
    opened.wait(f"Math.abs({HEIGHTS} - {2 * first}) < 1e-3 * {abs(first)}")
    opened.page.locator("#shape-view input[type=range]").fill("0")
    opened.wait(f"Math.abs({HEIGHTS}) < 1e-3")


def test_the_shape_turns_with_the_mouse_while_it_moves(opened: Opened) -> None:
    opened.to_shapes()
    opened.page.get_by_text("Play", exact=True).click()
    before = opened.value(EYE)
    canvas = opened.page.locator("#shape-view canvas")
    canvas.hover()  # scrolled to and standing still, or its middle may lie below the window
    box = canvas.bounding_box()
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


def test_a_click_on_a_cell_of_the_mac_shows_that_pair(opened: Opened) -> None:
    opened.page.locator("#correlation").scroll_into_view_if_needed()
    maps = opened.page.locator("#chart-mac_map svg[role=img]")
    # Rows are computed modes from below, columns test modes; the left map is that of before.
    cell = maps.nth(0).locator("rect.cell").nth(3 * 2 + 1)
    cell.click()
    opened.to_shapes()
    told = opened.page.inner_text(TOLD)
    assert told.startswith("test mode 2: 22.000 Hz, model before (mode 3): 32.550 Hz")
    assert opened.value(f"[{PLAYER}.now.test, {PLAYER}.now.model]") == [1, 2]
    table = opened.value("JSON.parse(document.getElementById('data').textContent).scene.states")
    assert told.endswith(f"MAC {table[0]['mac'][2][1]:.3f}")
    assert opened.complaints == []


def test_test_and_model_stand_side_by_side_or_overlaid(opened: Opened) -> None:
    opened.to_shapes()
    opened.page.get_by_label("undeformed").uncheck()
    together = opened.value(INKED)
    opened.page.get_by_text("side by side", exact=True).click()
    left, right = opened.value(INKED)
    assert min(together) > 0
    assert min(left, right) > 0
    opened.page.get_by_label("model", exact=True).uncheck()
    assert opened.value(INKED)[1] == 0  # the test is on the left alone


@pytest.mark.parametrize(("view", "flat"), [("front", True), ("side", True), ("top", False)])
def test_standard_views_look_along_the_axes(opened: Opened, view: str, flat: bool) -> None:
    opened.to_shapes()
    opened.page.locator("#shape-view input[type=range]").fill("0")
    opened.page.get_by_text(view, exact=True).click()
    opened.frames(2)
    # A plate in x and y, seen along y, x and z: lines but from above.
    shown = np.array(opened.value(INKED)).sum()
    assert (shown < 4000) == flat
    assert shown > 0


@pytest.mark.parametrize(("width", "scheme"), [(390, "dark"), (800, "light"), (1400, "dark")])
def test_it_fits_any_width_by_day_and_by_night(
    open_page: Open, record: CampaignRecord, width: int, scheme: str
) -> None:
    opened = open_page(record, width, color_scheme=scheme)
    opened.value("modetune.drawAll()")
    opened.to_shapes()
    sizes = "[document.documentElement.scrollWidth, document.documentElement.clientWidth]"
    scroll, client = opened.value(sizes)
    assert scroll == client == width
    wide = opened.value("document.querySelector('#shape-view canvas').clientWidth")
    assert 0.6 * min(width, 1000) < wide <= width
    # Everything in all its motion stays within the canvas: no ink on its rim.
    rim = opened.value(f"""(() => {{
        const {{ width, height, data }} = {PLAYER}.space.pixels(400), paper = data.slice(0, 3);
        let found = 0;
        for (let i = 0; i < width * height; i++) {{
            const x = i % width, y = Math.floor(i / width);
            if (x > 1 && x < width - 2 && y > 1 && y < height - 2) continue;
            found += paper.some((v, k) => Math.abs(v - data[4 * i + k]) > 12);
        }}
        return found;
    }})()""")
    assert rim == 0
    assert opened.complaints == []


def test_wide_tables_of_a_studys_page_stand_row_below_row_on_a_phone(
    browser: Any, tmp_path: Path
) -> None:
    heads = [Column("parameter", words=True), *(Column(f"of mode {n}", "%") for n in range(8))]
    table = Table("Shares", tuple(heads), (("E of the wing", *[0.5] * 8), ("rho", *[0.25] * 8)))
    file = write_study(tmp_path / "study.html", ("screen", "wing"), [table], ["a line"], [], {})
    where = "document.querySelector('.table')"
    cells = f"[...{where}.querySelectorAll('tbody td')].map((one) => one.getBoundingClientRect().x)"
    for width in (390, 1200):
        context = browser.new_context(viewport={"width": width, "height": 800})
        page = context.new_page()
        page.goto(file.as_uri())
        scroll, client = page.evaluate(f"[{where}.scrollWidth, {where}.clientWidth]")
        assert scroll == client < width
        # A column of cells, each behind its head; else as many columns as there are.
        assert len(set(page.evaluate(cells))) == (1 if width == 390 else 9)
        label = f"getComputedStyle({where}.querySelectorAll('td')[1], '::before').content"
        assert page.evaluate(label) == ('"of mode 0, %"' if width == 390 else "none")
        context.close()


def test_by_night_ink_is_light_on_dark_paper(open_page: Open, record: CampaignRecord) -> None:
    opened = open_page(record, color_scheme="dark")
    opened.value("modetune.drawAll()")
    colours = opened.value(
        "[getComputedStyle(document.body).backgroundColor, "
        "getComputedStyle(document.querySelector('#chart-frequencies text')).fill]"
    )
    paper, ink = (sum(map(int, one[4:-1].split(","))) for one in colours)
    assert paper < 150 < 400 < ink
    assert opened.value(f"{PLAYER}.space.paper")[0] < 0.2


def test_pictures_and_films_are_what_is_drawn(opened: Opened) -> None:
    opened.to_shapes()
    found = {}
    for kind in ("PNG", "GIF"):
        with opened.page.expect_download() as waiting:
            opened.page.get_by_text(kind, exact=True).click()
        assert waiting.value.suggested_filename == f"mode-1-model-1-after.{kind.lower()}"
        found[kind] = Image.open(io.BytesIO(Path(waiting.value.path()).read_bytes()))
    assert found["PNG"].size[0] == opened.value("document.querySelector('.frame canvas').width")
    film = found["GIF"]
    assert sum(1 for _ in ImageSequence.Iterator(film)) == 24
    assert film.size[0] == 640
    pictures = []
    for number in (0, 6, 12):
        film.seek(number)
        pictures.append(np.asarray(film.convert("RGB"), dtype=float))
    # A quarter and half a period later it looks otherwise; the first is the browser's picture.
    assert np.abs(pictures[0] - pictures[1]).max() > 50
    assert np.abs(pictures[0] - pictures[2]).max() > 50
    still = opened.value(f"Array.from({PLAYER}.space.pixels(640).data)")
    shown = np.array(still, dtype=float).reshape(*pictures[0].shape[:2], 4)[..., :3]
    # Colours are counted by 5 bits, and there are 256 of them: near, not the same.
    assert np.abs(shown - pictures[0]).mean() < 4.0
    assert opened.complaints == []


def still_field(surface: Surface, like: ModeSet) -> ModeSet:
    """As many modes at a surface that does not move."""
    n = surface.nodes.size
    shapes = np.zeros((3 * n, like.n_modes))
    return mode_set(like.frequencies_hz, shapes, np.repeat(surface.nodes, 3), np.tile([1, 2, 3], n))


def test_a_surface_round_test_points_is_seen_through(
    open_page: Open, record: CampaignRecord
) -> None:
    glass = f"{PLAYER}.space.layers.find((one) => one.which === 0).alpha"
    assert open_page(record).value(glass) == 1  # the sensors of the plate lie on it
    box = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=float)
    faces = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    triangles = np.array([[q[0], q[i], q[i + 1]] for q in faces for i in (1, 2)])
    surface = Surface(np.arange(1, 9), box, triangles, triangles[:, :2])
    assert record.places is not None
    inside = replace(record.places, coordinates=0.3 + 0.1 * record.places.coordinates)
    fields = [
        replace(item, field=still_field(surface, item.field)) if item.field.n_dof else item
        for item in record.iterations
    ]
    boxed = replace(record, surface=surface, places=inside, iterations=tuple(fields))
    assert open_page(boxed).value(glass) < 1


def test_the_pointer_tells_a_point_and_an_axis_is_drawn_out(opened: Opened) -> None:
    opened.value("modetune.drawAll()")
    chart = opened.page.locator("#chart-convergence svg[role=img]").first
    chart.hover()
    box = chart.bounding_box()
    mark = chart.locator("circle").first.bounding_box()
    opened.page.mouse.move(mark["x"] + mark["width"] / 2, mark["y"] + mark["height"] / 2)
    assert opened.page.inner_text(".tip").startswith("kept, 0: ")
    ticks = chart.locator("text.tick").all_text_contents()
    y = box["y"] + box["height"] / 2
    opened.page.mouse.move(box["x"] + 0.3 * box["width"], y)
    opened.page.mouse.down()
    opened.page.mouse.move(box["x"] + 0.5 * box["width"], y)
    opened.page.mouse.up()
    again = opened.page.locator("#chart-convergence svg[role=img]").first
    assert again.locator("text.tick").all_text_contents() != ticks
    again.dblclick()
    again = opened.page.locator("#chart-convergence svg[role=img]").first
    assert again.locator("text.tick").all_text_contents() == ticks


#: Contrast of each text of the page, and of each line and mark of its charts, with what is behind
#: it (WCAG 2.1): [[ratio, least, what]], maps and grids left out.
CONTRAST = """(() => {
    const shares = (text) => text.match(/[\\d.]+/g).map(Number);
    const light = ([r, g, b]) => [r, g, b].map((v) => v / 255)
        .map((v) => (v <= 0.04045 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4))
        .reduce((sum, v, k) => sum + v * [0.2126, 0.7152, 0.0722][k], 0);
    const ratio = (one, other) => {
        const [low, high] = [light(one), light(other)].sort((a, b) => a - b);
        return (high + 0.05) / (low + 0.05);
    };
    const behind = (node) => {
        for (let at = node; at; at = at.parentElement) {
            const found = shares(getComputedStyle(at).backgroundColor);
            if (found.length < 4 || found[3] > 0) return found;
        }
        return [255, 255, 255];
    };
    const found = [], seen = (node) => node.getClientRects().length > 0;
    const walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
    while (walker.nextNode()) {
        const text = walker.currentNode, node = text.parentElement;
        if (!text.textContent.trim() || !seen(node) || node.tagName === "OPTION") continue;
        const style = getComputedStyle(node), drawn = node instanceof SVGElement;
        const paper = node.classList.contains("value")
            ? shares(getComputedStyle(node.previousElementSibling).fill) : behind(node);
        found.push([ratio(shares(drawn ? style.fill : style.color), paper), 4.5,
            `${node.tagName} ${node.className.baseVal ?? node.className}: ${text.textContent}`]);
    }
    for (const node of document.querySelectorAll(
        ".chart svg g[clip-path] :is(path, circle, line, rect:not(.cell)), .legend svg *")) {
        const style = getComputedStyle(node);
        const colours = [style.stroke, style.fill].filter((one) => one.startsWith("rgb"));
        if (!seen(node) || !colours.length) continue;
        const best = Math.max(...colours.map((one) => ratio(shares(one), behind(node))));
        found.push([best, 3.0, `${node.tagName} of ${node.closest(".chart").id}: ${colours}`]);
    }
    return found;
})()"""
SIZES = (
    "[...document.querySelectorAll('body *')].filter((one) => one.getClientRects().length && "
    "[...one.childNodes].some((node) => node.nodeType === 3 && node.textContent.trim()))"
    ".map((one) => parseFloat(getComputedStyle(one).fontSize))"
)


def open_all(opened: Opened) -> None:
    opened.value("document.querySelectorAll('details').forEach((one) => { one.open = true; })")
    opened.value("modetune.drawAll()")
    shown = "document.querySelector('#chart-mac svg')"
    opened.wait(f"{shown} !== null")


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [390, 1280])
def test_every_text_and_line_is_seen_against_what_is_behind_it(
    open_page: Open, record: CampaignRecord, width: int, scheme: str
) -> None:
    opened = open_page(record, width, color_scheme=scheme)
    open_all(opened)
    found = opened.value(CONTRAST)
    assert len([least for _, least, _ in found if least == 3.0]) > 30
    assert len(found) > 200
    assert [(round(ratio, 2), what) for ratio, least, what in found if ratio < least] == []
    assert min(opened.value(SIZES)) >= 9.0


@pytest.mark.parametrize(("width", "height"), [(390, 844), (1280, 800)])
def test_the_first_screen_has_the_verdict_three_numbers_and_a_picture(
    open_page: Open, record: CampaignRecord, width: int, height: int
) -> None:
    opened = open_page(record, width, screen={"width": width, "height": height})
    opened.page.set_viewport_size({"width": width, "height": height})
    opened.wait("document.querySelector('#chart-errors svg rect') !== null")
    for place in (".ending", ".agreement dl div:nth-child(3)", "#chart-errors .panels"):
        box = opened.page.locator(place).bounding_box()
        assert 0 <= box["y"] < box["y"] + box["height"] <= height, place


def test_the_first_control_of_the_result_is_two_keys_away(opened: Opened) -> None:
    opened.wait("document.querySelector('#chart-errors .csv') !== null")
    opened.page.keyboard.press("Tab")
    assert opened.value("document.activeElement.textContent") == "Skip to the result"
    opened.page.keyboard.press("Enter")
    opened.page.keyboard.press("Tab")
    assert opened.value("document.activeElement.className") == "csv"


def test_each_chart_saves_its_numbers(opened: Opened) -> None:
    open_all(opened)
    shown = opened.value("[...document.querySelectorAll('[data-chart]')].map((one) => one.id)")
    tables = {}
    for place in shown:
        with opened.page.expect_download() as waiting:
            opened.page.locator(f"#{place} .csv").click()
        name = waiting.value.suggested_filename
        assert name == f"plate-{place.removeprefix('chart-')}.csv"
        text = Path(waiting.value.path()).read_text(encoding="utf-8")
        tables[place] = list(csv.DictReader(io.StringIO(text)))
    assert len(tables) > 6
    assert all(tables.values())
    bars = [row for row in tables["chart-errors"] if row["series"] == "after"]
    assert [row["test mode"] for row in bars] == ["1", "2", "5"]
    # The model is 0.1 % above the test.
    errors = [float(row["frequency error, %"]) for row in bars]
    assert errors == pytest.approx([0.1] * 3, rel=1e-5)
    cells = tables["chart-mac_map"]
    assert {row["panel"] for row in cells} == {"before", "after"}
    assert all(0.0 <= float(row["value"]) <= 1.0 for row in cells)
    assert all(url.startswith(("file:", "blob:")) for url in opened.requests)
    assert opened.complaints == []


def test_a_name_that_looks_like_a_formula_is_text_in_the_csv(opened: Opened) -> None:
    text = opened.value("""modetune.csv({ panels: [{ title: "", x: { label: "x", names: [] },
        y: { label: "y", names: [] }, items: [{ kind: "Curve", name: '=HYPERLINK("a","b")',
        x: [-1.5, null], y: [2, 3], labels: [], tooltips: [] }] }] })""")
    assert text == "".join(
        ["series,x,y\n", '"\'=HYPERLINK(""a"",""b"")",-1.5,2\n', '"\'=HYPERLINK(""a"",""b"")",,3\n']
    )


def test_print_has_all_of_it_within_its_width(opened: Opened) -> None:
    opened.value("dispatchEvent(new Event('beforeprint'))")  # comes before print's own style
    opened.page.emulate_media(media="print")
    opened.page.set_viewport_size({"width": 720, "height": 1000})  # A4 with margins
    opened.wait("document.querySelectorAll('.frame .still').length === 2")
    assert opened.value("[...document.querySelectorAll('details')].every((one) => one.open)")
    hidden = "getComputedStyle(document.querySelector('{}')).display"
    assert opened.value(hidden.format("#shape-view canvas:not(.still)")) == "none"
    for place in ("#shape-view", "#comac-view"):  # not one colour
        colours = opened.value(f"""(() => {{
            const kept = document.querySelector("{place} .still");
            const data = kept.getContext("2d").getImageData(0, 0, kept.width, kept.height).data;
            return new Set(new Uint32Array(data.buffer)).size;
        }})()""")
        assert colours > 10, place
    cut = opened.value("""[...document.querySelectorAll("main :is(table, svg, canvas, pre, p, li)")]
        .filter((one) => one.getClientRects().length
            && one.getBoundingClientRect().right > document.documentElement.clientWidth + 1)
        .map((one) => one.outerHTML.slice(0, 90))""")
    assert cut == []
    assert opened.page.pdf().startswith(b"%PDF")
    assert opened.complaints == []
