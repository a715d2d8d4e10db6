"""`modetune demo`: run a case of configs/ and compare it with its source.

Heavy packages are imported where they are needed.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from modetune.core.errors import CampaignError
from modetune.core.near_names import suggestion
from modetune.core.storage.files import check_writable
from modetune.flows.cli.command import run_study
from modetune.flows.cli.options import AsJson, NoPrefect, show_progress, stoppable
from modetune.flows.report.tables import Column, Table, json_object, show, table_of
from modetune.flows.studies.catalogue import find_study
from modetune.flows.studies.result import near

if TYPE_CHECKING:
    from modetune.configs.claims import Beside, Claim
    from modetune.configs.six_mass.methods import Outcome
    from modetune.flows.updating.record import CampaignRun


@dataclass(frozen=True, slots=True)
class CaseVerdict:
    """Findings of a case and whether they hold, with tables that compare it with its source, and
    figures."""

    claims: list[Claim]
    tables: list[Beside]
    figures: tuple[Path, ...] = ()


def demo(
    case: Annotated[
        str, typer.Argument(help="Case: mast, garteur, six-mass, fixture or lab.")
    ] = "mast",
    no_prefect: NoPrefect = False,
    as_json: AsJson = False,
) -> None:
    """Run a complete example in ./demo, and check what is known of it.

    The mast's test determines its parameters, whose true values are known. garteur, six-mass and
    fixture are cases of the thesis; lab starts with a laboratory's response functions. Exit code 3
    if e1 is not met, or if a claim about the case does not hold.
    """
    with show_progress(f"preparing the case {case}"):
        from modetune.configs.cases import write_case
        from modetune.flows.report.terminal import terminal
        from modetune.flows.updating.record import CampaignRun, summary

        if case not in DEMOS:
            raise CampaignError(f"there is no demo {case!r}{suggestion(case, DEMOS)}")
        source, campaign, judge = DEMOS[case]
        folder = Path("demo") / case
        check_writable(folder, "run it in another folder")
        write_case(source, folder)
        if case == "lab":
            _identify_modes(folder)
    with stoppable():
        parameters = {"campaign_file": folder / campaign, "runs": folder / "runs"}
        end = run_study(find_study("update"), parameters, no_prefect or case not in WITH_PREFECT)
        run = end.found
        assert isinstance(run, CampaignRun)
        found = judge(run, folder)
    if as_json:
        case_summary = json_object(found, "claims tables figures")
        typer.echo(json.dumps({**summary(run.record, near(run.folder)), **case_summary}))
    else:
        assert end.shown is not None
        end.shown(terminal())
        _show(found)
    holds = all(claim.holds for claim in found.claims)
    raise typer.Exit(0 if run.record.status == "converged" and holds else 3)


def _identify_modes(folder: Path) -> None:
    """Write lab.unv as the lab delivers it, and identify modes.csv from it."""
    from modetune.adapters.test_files.measurements import read_measurement
    from modetune.configs.garteur.lab import BAND_HZ, write_lab
    from modetune.flows.studies.identify.identification import (
        IdentificationSettings,
        identify,
        write_modes,
    )

    write_lab(folder)
    measured = read_measurement([folder / "lab.unv"])
    assert measured.frfs is not None
    found = identify(measured.frfs, IdentificationSettings(band_hz=BAND_HZ))
    write_modes(folder / "modes.csv", found, measured.geometry, "lab.unv")


def _judge_mast(run: CampaignRun, folder: Path) -> CaseVerdict:
    from modetune.configs.mast import twin

    return CaseVerdict(twin.claims(run.record), [])


def _judge_garteur(run: CampaignRun, folder: Path) -> CaseVerdict:
    from modetune.configs.garteur import thesis

    return CaseVerdict(thesis.claims(run.record), [])


def _judge_lab(run: CampaignRun, folder: Path) -> CaseVerdict:
    from modetune.configs.garteur import lab

    return CaseVerdict(lab.claims(run.record), [])


def _judge_fixture(run: CampaignRun, folder: Path) -> CaseVerdict:
    from modetune.configs.fixture import thesis

    return CaseVerdict(thesis.claims(run.record), thesis.beside(run.record))


def _judge_six_mass(run: CampaignRun, folder: Path) -> CaseVerdict:
    """Compare the campaign with the direct methods, which run here."""
    from modetune.configs.six_mass import methods

    direct = methods.direct_outcomes()
    updated = methods.eigensensitivity_outcome(run.updated_deck)
    outcomes = [*direct, updated]
    return CaseVerdict(
        methods.claims(direct, updated, run.record),
        methods.beside(outcomes, run.record),
        tuple(path for item in outcomes for path in _figures(item, folder / "figures")),
    )


def _figures(result: Outcome, folder: Path) -> list[Path]:
    """Plot an outcome's MAC, frequencies, and the receptances shown in the thesis."""
    from modetune.configs.six_mass.methods import EXCITATION_HZ
    from modetune.flows.report.campaign_charts import frequencies, mac_towers, responses
    from modetune.flows.report.matplotlib_charts import save
    from modetune.flows.report.response_functions import ResponseCurve

    stem, hz = result.name.replace(" ", "_"), (result.test, result.before, result.after)
    numbers = range(1, 7)
    macs = (("before updating", result.mac_before), ("after updating", result.mac_after))
    charts = {
        "mac": mac_towers(result.title, macs, numbers),
        "frequencies": frequencies(result.title, numbers, *(state.frequencies_hz for state in hz)),
    }
    receptances = [state.point_receptances() for state in hz]
    for mass in result.shown:
        test, before, after = (values[:, mass - 1] for values in receptances)
        text = ", not measured" if mass in result.unmeasured else ""
        title = f"{result.title}\npoint receptance of mass {mass}{text}"
        curves = [
            ResponseCurve("test", "experimental", test),
            ResponseCurve("before", "analytical", before),
            ResponseCurve("after", "updated", after),
        ]
        charts[f"receptance_{mass}"] = responses(title, "|x / f|, m/N", EXCITATION_HZ, curves)
    return [save(chart, folder / f"{stem}_{name}.png") for name, chart in charts.items()]


def _show(found: CaseVerdict) -> None:
    for item in found.tables:
        columns = tuple(
            Column(heading, words=place == 0) for place, heading in enumerate(item.headings)
        )
        show([Table(item.title, columns, item.rows)])
    outside = [(place, "holds") for place, item in enumerate(found.claims) if not item.holds]
    columns = (
        Column("claim", words=True, name="claim"),
        Column("holds", name="holds"),
        Column("by", words=True, name="evidence"),
    )
    figures = [f"figures      {found.figures[0].parent}"] if found.figures else []
    show([table_of("Claims", found.claims, columns, outside=outside), *figures])


#: Demos that run as Prefect flows; the others need no server.
WITH_PREFECT = ("mast", "garteur")
#: Case in configs/, campaign and assessment of each demo.
DEMOS = {
    "mast": ("mast", "mast.yaml", _judge_mast),
    "garteur": ("garteur", "thesis.yaml", _judge_garteur),
    "six-mass": ("six_mass", "campaign.yaml", _judge_six_mass),
    "fixture": ("fixture", "fixture.yaml", _judge_fixture),
    "lab": ("garteur", "lab.yaml", _judge_lab),
}
