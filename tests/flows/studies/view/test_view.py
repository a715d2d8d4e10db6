"""`modetune view` in a real browser and by plain requests: who may look, and what is written."""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from modetune.adapters.test_files.measurements import read_measurement
from modetune.flows.campaign.campaign import load_campaign
from modetune.flows.campaign.schema import STORE_VARIABLE
from modetune.flows.updating.display import ConsoleProgress
from modetune.flows.updating.update import update_campaign
from tests.adapters.solved import needs_ccx
from tests.eventually import eventually
from tests.flows.studies.view.hook import MOVED, TURN, Hook, write_hook

pytestmark = needs_ccx
PATIENCE_MS = 60_000


@dataclass(frozen=True, slots=True)
class Viewed:
    """A server, its address with the token, and the campaign it shows."""

    address: str
    hook: Hook

    @property
    def base(self) -> str:
        return self.address.partition("/?")[0]

    def text(self) -> str:
        return self.hook.campaign.read_text()


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Hook:
    return write_hook(tmp_path_factory.mktemp("hook"))


@pytest.fixture
def hook(made: Hook, tmp_path: Path) -> Hook:
    """A copy of it, with the store that has the first model."""
    folder = tmp_path / "hook"
    shutil.copytree(made.campaign.parent, folder)
    return Hook(folder / "hook.yaml", made.coordinates, made.elements, made.sensors)


@pytest.fixture
def viewed(hook: Hook) -> Iterator[Viewed]:
    """The command itself, in a process of its own."""
    server = subprocess.Popen(
        [sys.executable, "-m", "modetune", "view", hook.campaign.name],
        cwd=hook.campaign.parent,
        env={name: value for name, value in os.environ.items() if name != STORE_VARIABLE},
        stdout=subprocess.PIPE,
        text=True,
    )
    assert server.stdout is not None
    told = re.fullmatch(r"view  (http://127\.0\.0\.1:\d+/\?token=\S+)\n", server.stdout.readline())
    assert told is not None
    yield Viewed(told[1], hook)
    server.send_signal(signal.SIGINT)
    server.stdout.close()
    assert server.wait(30) == 130


@pytest.fixture
def page(browser: Any, viewed: Viewed) -> Iterator[Any]:
    """The page, opened by its token; it complains of nothing and asks nobody else."""
    page = browser.new_page(viewport={"width": 1400, "height": 900})
    page.set_default_timeout(PATIENCE_MS)
    complaints: list[str] = []
    asked: list[str] = []
    page.on("pageerror", lambda error: complaints.append(str(error)))
    page.on("console", lambda said: complaints.append(said.text) if said.type == "error" else None)
    page.on("request", lambda request: asked.append(request.url))
    page.goto(viewed.address)
    yield page
    page.close()
    assert complaints == []
    assert {url for url in asked if not url.startswith((viewed.base, "blob:", "data:"))} == set()


def write_change(page: Any, which: str) -> str:
    """Show a change, write it, and give the difference that was shown."""
    page.click(f"#{which}-change")
    page.wait_for_selector("#change[open]")
    shown = str(page.inner_text("#diff"))
    page.click("#write")
    page.wait_for_selector("#change:not([open])", state="attached")
    return shown


def test_a_browser_is_opened_without_the_token_on_its_command_line(
    hook: Hook, tmp_path: Path
) -> None:
    """Any account can read command lines: the browser gets a page of this account that leads on."""
    told, program = tmp_path / "told", tmp_path / "browser"
    program.write_text(
        f'#!/bin/sh\npage="${{1#file://}}"\n{{ echo "$1"; stat -c %a "$page"; cat "$page"; }} '
        f">{told}.part\nmv {told}.part {told}\n"
    )
    program.chmod(0o700)
    server = subprocess.Popen(
        [sys.executable, "-m", "modetune", "view", hook.campaign.name, "--open"],
        cwd=hook.campaign.parent,
        env={**os.environ, "BROWSER": str(program)},
        stdout=subprocess.PIPE,
        text=True,
    )
    assert server.stdout is not None
    address = server.stdout.readline().split()[1]
    eventually(told.exists)
    opened, mode, text = told.read_text().splitlines()
    assert address.partition("token=")[2] not in opened
    assert mode == "600"
    assert f'url={address}"' in text
    server.send_signal(signal.SIGINT)
    server.stdout.close()
    assert server.wait(30) == 130
    assert not Path(opened.removeprefix("file://")).exists()


def test_only_the_token_opens_the_page_once_and_only_this_host_and_page_may_ask(
    viewed: Viewed,
) -> None:
    with httpx.Client(base_url=viewed.base) as client:
        assert client.get("/").status_code == 403
        assert client.get("/live").status_code == 403
        assert client.get("/?token=guessed").status_code == 403
        opened = client.get(viewed.address)
        assert (opened.status_code, opened.headers["location"]) == (303, "/")
        cookie = opened.headers["set-cookie"]
        assert "HttpOnly" in cookie
        assert "SameSite=strict" in cookie
        shown = client.get("/")
        assert shown.status_code == 200
        assert "script-src 'self'" in shown.headers["content-security-policy"]
        assert not [name for name in shown.headers if name.startswith("access-control")]
        assert client.get("/live").json()["status"] == "not run yet"
        assert client.get(viewed.address).status_code == 303  # who is in may press it again

        # A name that was made to point here, and the right name with another port.
        for host in ("evil.example", "evil.example:80", "127.0.0.1:1"):
            assert client.get("/live", headers={"host": host}).status_code == 400
        before = viewed.text()
        asked = {"pairs": {"1": 2}, "base": "0"}
        for origin in ({}, {"origin": "http://evil.example"}, {"origin": "null"}):
            assert client.post("/change", json=asked, headers=origin).status_code == 403
        mine = {"origin": viewed.base}
        stale = client.post("/change", json=asked, headers=mine)
        assert stale.status_code == 422
        assert "has changed since" in stale.json()["problems"][0]
        assert viewed.text() == before
        preflight = client.options("/change", headers={"origin": "http://evil.example"})
        assert preflight.status_code == 403
    assert httpx.get(viewed.address).status_code == 403  # it was used


def test_it_listens_on_the_loopback_device_alone(viewed: Viewed) -> None:
    port = int(viewed.base.rpartition(":")[2])
    listening = Path("/proc/net/tcp").read_text().splitlines()[1:]
    places = [line.split()[1] for line in listening if line.split()[3] == "0A"]
    assert [place for place in places if int(place[-4:], 16) == port] == [f"0100007F:{port:04X}"]


def test_an_iteration_appears_while_the_page_is_open(
    page: Any, viewed: Viewed, monkeypatch: pytest.MonkeyPatch
) -> None:
    for wait in ("LATE_S", "LATE"):  # as of iterations that take longer
        monkeypatch.setattr(f"modetune.flows.updating.record.{wait}", 0.0)
    page.wait_for_selector("#status:has-text('not run yet')")
    campaign = load_campaign(viewed.hook.campaign)
    folder = viewed.hook.campaign.parent / "runs" / "hook"

    class Watching(ConsoleProgress):
        seen: tuple[str, ...] = ()

        def working(self, text: str) -> None:
            """The first iteration is on the page before the campaign goes on."""
            if not self.seen and (folder / "campaign.unfinished.h5").exists():
                page.wait_for_selector("#tables td:has-text('initial model')")
                self.seen = (page.inner_text("#status"), page.inner_text("#log"))

    from modetune.flows.report.terminal import terminal

    progress = Watching(terminal(stderr=True))
    run = update_campaign(campaign, folder, progress)
    assert progress.seen[0] == "running"
    assert "iteration 0: largest frequency error 7.57 %" in progress.seen[1]
    page.wait_for_selector("#status:has-text('converged')")
    assert page.locator("#tables table >> nth=0").locator("tbody tr").count() == len(
        run.record.iterations
    )
    page.click("[data-tab=shapes]")
    report = page.frame_locator("#report")
    report.locator("#shape-view canvas").wait_for()
    assert report.locator("#shape-view select").first.locator("option").count() >= 4


def test_a_pair_made_by_a_click_lands_in_the_file_and_comments_stay(
    page: Any, viewed: Viewed
) -> None:
    before = viewed.text()
    page.click("[data-tab=pairs]")
    page.click("#solve")  # the store has the true hook only
    cell = "[aria-label='test mode 4 with elastic mode {}']"
    page.wait_for_selector(cell.format(4) + ".paired")
    assert page.inner_text(cell.format(4)).startswith("1.00")
    page.click(cell.format(5))
    assert page.get_attribute(cell.format(5), "aria-pressed") == "true"
    shown = write_change(page, "pairs")
    assert "+  pairs: {4: 5}" in shown
    assert viewed.text() == before.replace("parameters:\n", "  pairs: {4: 5}\nparameters:\n", 1)
    page.wait_for_selector(cell.format(5) + ".by-hand")
    assert load_campaign(viewed.hook.campaign).case.rules.by_hand == {4: 5}
    page.click(cell.format(5))  # undone: the file is what it was
    write_change(page, "pairs")
    assert viewed.text() == before


def test_poles_picked_become_the_modes_of_the_campaign(page: Any, viewed: Viewed) -> None:
    page.click("[data-tab=poles]")
    page.wait_for_selector("#tracks button")
    picked = page.locator("#tracks button[aria-pressed=true]")
    assert picked.count() == 5
    true = read_measurement([viewed.hook.campaign.parent / "modes.csv"]).modes
    assert true is not None
    # The third column is left out by a press into the diagram, where its line stands.
    line = page.locator("#diagram .panels > svg").first.locator("g[clip-path] > line").nth(2)
    box = line.bounding_box()
    page.mouse.click(box["x"], box["y"] + 10.0)
    assert picked.count() == 4
    shown = write_change(page, "poles")
    assert "+  modes: [hook-picked.csv, points.csv, frfs.h5]" in shown
    found = read_measurement([viewed.hook.campaign.parent / "hook-picked.csv"]).modes
    assert found is not None
    # Functions without noise: poles are exact to what the residual terms leave.
    wanted = np.delete(true.modes.frequencies_hz, 2)
    assert found.modes.frequencies_hz == pytest.approx(wanted, rel=1e-5)
    assert load_campaign(viewed.hook.campaign).test.numbers == (1, 2, 3, 4)
    assert "# the fifth is weak" in viewed.text()


def test_a_section_says_what_it_waits_for(page: Any, viewed: Viewed) -> None:
    held: list[Any] = []
    page.route("**/sensors?*", lambda route: held.append(route))
    with page.expect_request("**/sensors?*"):
        page.click("[data-tab=sensors]")
    page.wait_for_selector("body[aria-busy]")
    shown = "getComputedStyle(document.getElementById('sensors'), '::before').content"
    assert "Reading the campaign, its model and its test" in page.evaluate(shown)
    held[0].continue_()
    page.wait_for_selector("body:not([aria-busy])")
    assert page.evaluate(shown) == "none"


def test_three_landmarks_lay_the_test_over_the_model(page: Any, viewed: Viewed) -> None:
    page.click("[data-tab=sensors]")
    page.locator("#landmarks th").nth(2).wait_for(state="attached")
    sensors = viewed.hook.sensors
    for place in (0, 7, 13):
        for which, number in (("test", 101 + place), ("model", int(sensors[place]) + 1)):
            # From where the node is in front, as a user turns it.
            x, y = visible(page, which, number)
            box = page.locator(f"#{which}-space").bounding_box()
            page.mouse.click(box["x"] + x, box["y"] + y)
    shown = write_change(page, "sensors")
    nodes = {101 + place: int(sensors[place]) + 1 for place in (0, 7, 13)}
    told = ", ".join(f"{point}: {node}" for point, node in nodes.items())
    assert f"match: {{{told}}}" in shown
    assert "rotation" not in viewed.text()
    assert "# no idea yet how the test's axes lie" in viewed.text()
    found = load_campaign(viewed.hook.campaign).case.mapping.alignment
    assert found is not None
    # Places of the file have 16 digits; the fit is exact to rounding of places of some 100 mm.
    back = TURN.inv()
    assert np.abs(found.rotation - back.as_matrix()).max() < 1e-9
    assert np.abs(found.translation + back.apply(MOVED)).max() < 1e-6


def visible(page: Any, which: str, number: int) -> tuple[float, float]:
    """Where a point is on its canvas, after the view was turned until a press there finds it."""
    for _ in range(24):
        found = page.evaluate(f"modetune.press('{which}', {number})")
        if found["number"] == number:
            return float(found["x"]), float(found["y"])
        page.focus(f"#{which}-space")
        for _ in range(4):
            page.keyboard.press("ArrowRight")
    raise AssertionError(f"{which} {number} is never in front")


def test_a_doubt_is_resolved_by_its_control_and_comments_stay(page: Any, viewed: Viewed) -> None:
    campaign = viewed.hook.campaign
    before = viewed.text().replace("bounds: [0.5, 1.5]", "bounds: [0.01, 30.0]", 1)
    campaign.write_text(before)
    page.click("[data-tab=doubts]")
    doubt = page.locator("#doubt-list li", has_text="too wide to limit anything")
    doubt.wait_for()
    assert page.locator("#doubt-list li").count() >= 1
    field = doubt.locator("input")
    assert field.input_value() == "[0.5, 2.0]"
    field.fill("[0.6, 1.4]")
    doubt.locator("button").click()
    page.wait_for_selector("#change[open]")
    shown = page.inner_text("#diff")
    assert "material: FOOT, bounds: [0.6, 1.4]}" in shown
    assert viewed.text() == before  # not before it is confirmed
    page.click("#write")
    page.wait_for_selector("#change:not([open])", state="attached")
    assert viewed.text() == before.replace("[0.01, 30.0]", "[0.6, 1.4]")
    doubt.wait_for(state="detached")
    page.click("#check")
    page.wait_for_selector("#doubt-count:has-text('other finding')")
    page.wait_for_selector("#unsolved", state="hidden")
