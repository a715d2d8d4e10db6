"""The report as a file: what stands in it, and that nothing a user wrote is taken for markup."""

from __future__ import annotations

import base64
import json
import re
from collections.abc import Callable
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from modetune.core.modes import Floats, MeasuredModes, mode_set
from modetune.core.parameters import ParameterSet
from modetune.core.storage.campaign_record import CampaignRecord, read_record, write_record
from modetune.flows import report
from modetune.flows.report.chart import AFTER, BEFORE
from modetune.flows.report.page import page, write_page
from modetune.flows.report.report_file import draw_report

Make = Callable[[int], CampaignRecord]
EVIL = "</script><img src=x onerror=alert(1)><b>&\"'"
MEGABYTE = 1_000_000


class Outline(HTMLParser):
    """Tags with their attributes, and the text outside scripts."""

    def __init__(self, source: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.text = ""
        self.feed(source)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))

    def handle_data(self, data: str) -> None:
        if self.cdata_elem is None:
            self.text += data.replace("\N{NO-BREAK SPACE}", " ")

    def named(self, tag: str) -> list[dict[str, str | None]]:
        return [attributes for name, attributes in self.tags if name == tag]


def data_of(source: str) -> dict[str, dict[str, object]]:
    found = re.search(r'<script type="application/json" id="data">(.*?)</script>', source, re.S)
    assert found is not None
    told: dict[str, dict[str, object]] = json.loads(found[1])
    return told


def test_every_section_stands_in_the_contents(record: CampaignRecord) -> None:
    outline = Outline(page(record))
    sections = [item["id"] for item in outline.named("section")]
    links = [item["href"] for item in outline.named("a")]
    skip, *contents = links
    assert skip == "#summary"
    assert contents == [f"#{name}" for name in sections]
    assert set(sections) >= {
        "summary", "modes", "correlation", "shapes", "sensors", "parameters", "sensitivities",
        "convergence", "pairing", "runs", "repeat",
    }  # fmt: skip


def test_the_summary_tells_how_far_the_model_came(record: CampaignRecord) -> None:
    text = Outline(page(record)).text
    # The plate's modes are made 5 % off at first and 0.1 % at last; t rises by 20 %, its bound.
    assert "error fell from 5.00 % (mode 1) to 0.10 % (mode 1)" in text
    assert "The model of plate agrees with its test." in text
    assert "t changed most (+20.0 %); on a bound: t." in text
    assert "3 iterations" not in text
    assert "2 iterations, 9 solver runs (1 more cached)" in text


def ended_worse(record: CampaignRecord, off: float, macs: Floats) -> CampaignRecord:
    """The last iteration kept has errors and MACs of its own; it began 5 % off."""
    last = record.best
    worse = replace(last, frequency_errors=np.full(3, off), pairing=replace(last.pairing, mac=macs))
    return replace(record, iterations=(*record.iterations[:-1], worse), status="max_iterations")


def test_an_update_that_made_it_worse_is_not_praised(record: CampaignRecord) -> None:
    macs = np.array([0.9, 0.5, 0.9])
    text = Outline(page(ended_worse(record, 0.06, macs))).text
    assert "The model of plate is no closer to its test than before." in text
    assert (
        "largest frequency error did not improve: it went from 5.00 % (mode 1) to 6.00 % (mode 1)"
    ) in text
    assert "the mean error did not improve: it went from 5.00 % to 6.00 %" in text
    least = record.iterations[0].pairing.mac.min()
    assert "Mode shapes did not improve: the lowest MAC fell from " in text
    assert f"from {least:.3f} (mode " in text
    assert "to 0.500 (mode 2)" in text
    assert "error fell" not in text


def test_an_update_that_is_better_in_part_says_so(record: CampaignRecord) -> None:
    text = Outline(page(ended_worse(record, 0.02, np.array([0.9, 0.5, 0.9])))).text
    assert "The model of plate is closer to its test in part only." in text
    assert "largest frequency error fell from 5.00 % (mode 1) to 2.00 % (mode 1)" in text
    assert "the mean error fell from 5.00 % to 2.00 %" in text
    assert "Mode shapes did not improve" in text


def test_parameters_have_units_and_errors_in_percent(record: CampaignRecord) -> None:
    source = page(record)
    assert '<td>210000</td><td>210000</td><td class="words">MPa</td>' in source
    assert '<td>2</td><td>2.4</td><td class="words">mm</td>' in source  # 20 % more
    assert "<th>standard error, of deck, %</th>" in source
    assert "<td>1.00</td><td>0.5, 2</td>" in source
    assert "MPa" not in Outline(page(replace(record, units=""))).text


def test_the_decks_digest_is_called_what_it_is(record: CampaignRecord) -> None:
    told = replace(record, deck_digest="e" * 64 + "  plate.inp")
    assert "SHA-256 of the deck" + "e" * 64 + "  plate.inp" in Outline(page(told)).text
    assert "content key of the deck" in Outline(page(record)).text
    bare = Outline(page(replace(record, deck_digest=""))).text
    assert "sha256sum" not in bare
    assert "content key of the deck" not in bare


def test_modes_of_configurations_have_their_names(record: CampaignRecord) -> None:
    test = replace(record.test, numbers=(1, 2, 3))
    source = page(replace(record, test=test, configurations=("full", "full", "<b>empty")))
    text = Outline(source).text
    assert "3 of <b>empty" in text
    charts = json.dumps(data_of(source)["charts"])
    assert "3 of <b>empty" in charts  # as JSON; the page's script sets it as text
    assert "<b>empty" not in source
    assert data_of(source)["scene"]["tests"][2]["label"] == "3 of <b>empty"  # type: ignore[index]  # JSON


def test_the_test_has_one_colour_in_all_charts() -> None:
    scripted = (Path(report.__file__).parent / "shapes.js").read_text()
    assert AFTER not in scripted
    assert BEFORE not in scripted


def test_it_holds_what_a_repetition_needs(record: CampaignRecord) -> None:
    text = Outline(page(record)).text
    for needed in (
        "name: plate\n",
        "run.parallel=2",
        "d" * 64,
        "0" * 64,
        "ab" * 32,
        "numpy 1",
        "scripted 1",
        "SKIN, RIB",
    ):
        assert needed in text


def test_nothing_a_user_wrote_is_markup(record: CampaignRecord) -> None:
    parameters = ParameterSet(
        tuple(replace(item, name=EVIL, targets=(EVIL,)) for item in record.parameters.parameters)
    )
    items = tuple(
        replace(
            item, decision=EVIL, modal_key=EVIL, pairing=replace(item.pairing, reasons=(EVIL,) * 3)
        )
        for item in record.iterations
    )
    hostile = replace(
        record,
        name=EVIL,
        campaign_text=EVIL,
        reason=EVIL,
        settings=(EVIL,),
        parameters=parameters,
        iterations=items,
        status=EVIL,
        solver=EVIL,
        versions=(EVIL,),
        deck_digest=EVIL,
        units=EVIL,
    )
    clean, outline = Outline(page(record)), Outline(page(hostile))
    assert not outline.named("img")
    assert not outline.named("b")
    assert len(outline.named("script")) == len(clean.named("script"))
    assert not [name for _, attributes in outline.tags for name in attributes if name[:2] == "on"]
    assert EVIL in outline.text
    # In charts it is JSON, in which no sign of a tag stands, and the page's script sets it as text.
    assert EVIL in json.dumps(data_of(page(hostile))["charts"]["parameters"]).replace('\\"', '"')
    assert "<img" not in page(hostile)


def test_the_policy_names_the_scripts_and_forbids_the_network(record: CampaignRecord) -> None:
    outline = Outline(page(record))
    (policy,) = [
        item["content"] or ""
        for item in outline.named("meta")
        if item.get("http-equiv") == "Content-Security-Policy"
    ]
    assert policy.startswith("default-src 'none'; script-src 'sha256-")
    assert "unsafe-eval" not in policy
    assert "http" not in policy
    scripts = policy.partition("script-src")[2].partition(";")[0]
    assert "unsafe-inline" not in scripts
    assert scripts.count("sha256-") == len(outline.named("script")) - 1  # one holds data
    loading = [
        value for _, item in outline.tags for key in ("src", "href") if (value := item.get(key))
    ]
    assert all(value.startswith("#") for value in loading)


def test_a_hundred_thousand_nodes_stay_below_two_megabytes(record_of: Make, tmp_path: Path) -> None:
    record = record_of(317)  # 317 x 317 = 100,489 nodes
    written = write_page(record, tmp_path / "report.html")
    assert written.stat().st_size < 2 * MEGABYTE
    scene = data_of(written.read_text())["scene"]
    coordinates = np.frombuffer(base64.b64decode(str(scene["coordinates"])), "<f4").reshape(-1, 3)
    assert 1000 < coordinates.shape[0] <= 12_000
    # Thinned, it is still the whole plate of 2 x 1.
    assert np.ptp(coordinates, axis=0) == pytest.approx([2.0, 1.0, 0.0], abs=0.05)


def test_it_is_the_same_from_the_file_as_from_the_campaign(
    record: CampaignRecord, tmp_path: Path
) -> None:
    write_record(tmp_path / "campaign.h5", record)
    told, read = (data_of(page(one)) for one in (record, read_record(tmp_path / "campaign.h5")))
    assert told["charts"].keys() == read["charts"].keys()
    assert Outline(page(read_record(tmp_path / "campaign.h5"))).text == Outline(page(record)).text


def test_without_a_surface_the_sensors_move(record: CampaignRecord) -> None:
    items = tuple(replace(item, field=mode_set([])) for item in record.iterations)
    scene = data_of(page(replace(record, surface=None, iterations=items)))["scene"]
    assert scene["triangles"] == ""
    assert scene["points"] == scene["coordinates"] != ""


def test_without_places_shapes_are_drawn_over_the_sensors(record: CampaignRecord) -> None:
    bare = replace(record, surface=None, geometry=None, sensors=None, places=None)
    source = page(bare)
    assert data_of(source)["scene"] is None
    assert "sensor_shapes" in data_of(source)["charts"]


def test_a_test_of_frequencies_alone_has_a_report(record: CampaignRecord) -> None:
    unknown = np.full(3, np.nan)
    items = tuple(
        replace(item, pairing=replace(item.pairing, mac=unknown, subspace_mac=unknown))
        for item in record.iterations
    )
    test = MeasuredModes(record.test.numbers, mode_set(record.test.modes.frequencies_hz))
    bare = replace(record, test=test, iterations=items, sensors=None, places=None, geometry=None)
    source = page(bare)
    ids = [item["id"] for item in Outline(source).named("section")]
    assert "correlation" not in ids
    assert "sensors" not in ids
    assert "shapes" in ids  # the model's own shapes
    assert "Without measured shapes" in Outline(source).text


def test_a_report_that_cannot_be_drawn_is_a_warning(
    record: CampaignRecord, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    broken = replace(record, iterations=())
    assert draw_report(broken, tmp_path) is None
    assert "the report of plate failed (IndexError" in caplog.text
    assert not list(tmp_path.iterdir())


def test_a_folder_that_is_no_folder_is_a_warning(
    record: CampaignRecord, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "file").write_text("")
    assert draw_report(record, tmp_path / "file") is None
    assert "the report of plate failed" in caplog.text
