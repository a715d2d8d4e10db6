"""One model on several solvers: the Python API of `modetune model twin`.

The modal analysis of a campaign runs on each solver that is there, and the modes of each are
paired with those of the first by shape. Frequencies side by side with MAC between the solvers'
shapes show, say, how far CI with CalculiX is from Nastran.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from modetune.adapters.yaml_file import read_yaml
from modetune.core.correlation.pairing import Pairing, pair_by_shape
from modetune.core.errors import CampaignError, SolverMissing
from modetune.core.modes import Floats, ModeSet
from modetune.core.storage.keys import Json
from modetune.core.updating.job_results import ModalResult
from modetune.flows.campaign.campaign import Campaign, load_campaign
from modetune.flows.campaign.case import EXTRA_MODES
from modetune.flows.campaign.schema import override
from modetune.flows.campaign.test import tracking_nodes
from modetune.flows.report.tables import Column, Table, json_object
from modetune.flows.updating.mode_source import model_modes, parse_values


@dataclass(frozen=True, slots=True)
class SolverModes:
    """The modes that one solver gives, and how they answer those of the first solver.

    pairing: of the first solver's lowest elastic modes with this one's; masses: why its masses are
    not those that the deck asks for, empty where they are.
    """

    solver: str
    version: str
    wall_s: float
    result: ModalResult
    pairing: Pairing
    masses: str

    @property
    def frequencies_hz(self) -> Floats:
        """Of the paired modes, (n_pairs,)."""
        return self.result.elastic.frequencies_hz[self.pairing.computed]


@dataclass(frozen=True, slots=True)
class Twin:
    """A model's modes by several solvers; absent: solvers that could not run, and why."""

    name: str
    solvers: tuple[SolverModes, ...]
    absent: tuple[tuple[str, str], ...]

    def differences(self, solver: SolverModes) -> Floats:
        """Relative frequency differences of a solver from the first one, (n_pairs,)."""
        return solver.frequencies_hz / self.solvers[0].frequencies_hz - 1.0


def run_twin(
    campaign_file: Path, solvers: Sequence[str], at: list[str], settings: list[str]
) -> Twin:
    """Run a campaign's modal analysis on each of these solvers.

    A solver that is not installed, or cannot take the model, is absent with the reason.
    Raises CampaignError where none is left, SolverError, StoreError.
    """
    if len(set(solvers)) != len(solvers):
        raise CampaignError(f"--solvers names one twice: {', '.join(solvers)}")
    if override(read_yaml(campaign_file, "a campaign"), settings).get("configurations"):
        raise CampaignError(
            f"{campaign_file}: solvers are compared on one model, and the campaign has several "
            "configurations; give a campaign file with one of them as `model` and `test`"
        )
    campaigns: list[Campaign] = []
    absent: list[tuple[str, str]] = []
    for solver in solvers:
        try:
            other = [] if solver == "command" else ["model.command=null"]
            asked = [*settings, f"model.solver={solver}", *other]
            campaign = load_campaign(campaign_file, asked)
            campaign.solver_version()
            campaigns.append(campaign)
        except (CampaignError, SolverMissing) as error:
            absent.append((solver, str(error)))
    if not campaigns:
        raise CampaignError([f"{solver}: {reason}" for solver, reason in absent])
    # Shapes at a few sensors would not distinguish modes.
    models = [campaign.case.solver.deck.summary for campaign in campaigns]
    nodes = tracking_nodes(frozenset.intersection(*(model.node_ids for model in models)))
    done: list[SolverModes] = []
    for campaign in campaigns:
        campaign = replace(campaign, cases=(replace(campaign.case, nodes=nodes),))
        started = time.monotonic()
        result = model_modes(campaign, parse_values(campaign, at))
        wall_s = time.monotonic() - started
        first = done[0].result if done else result
        pairing = _pairs(first.elastic, result.elastic)
        name, version = campaign.solver_name, campaign.solver_version()
        masses = campaign.case.solver.other_masses
        done.append(SolverModes(name, version, wall_s, result, pairing, masses))
    return Twin(campaigns[0].name, tuple(done), tuple(absent))


def _pairs(first: ModeSet, second: ModeSet) -> Pairing:
    """Pairs of the first solver's modes with the second's; the highest are left to spare.

    A mode at the end of the range may have its partner beyond it. No MAC is too low: a low one is
    what a twin run is to show.
    """
    count = max(1, min(first.n_modes, second.n_modes) - EXTRA_MODES // 2)
    return pair_by_shape(first.select(np.arange(count)), second, lost_mac=-1.0)


def twin_summary(twin: Twin) -> dict[str, Json]:
    """Return the JSON object of a comparison of solvers."""
    return json_object(
        twin,
        "name",
        solvers=[
            json_object(
                item,
                "solver wall_s frequencies_hz masses",
                solver_version=item.version,
                rigid_modes=item.result.n_rigid,
                mass=item.result.mass,
                differences=twin.differences(item),
                mac=item.pairing.judged_mac,
                pairing=item.pairing.reasons,
            )
            for item in twin.solvers
        ],
        absent=dict(twin.absent),
    )


def twin_parts(twin: Twin) -> list[Table | str]:
    """Frequencies of all solvers side by side, differences and MAC from the first."""
    first, *others = twin.solvers
    columns = [Column("mode"), Column(first.solver, "Hz", ".4f")]
    values: list[list[float]] = [
        [pair + 1 for pair in range(first.frequencies_hz.size)],
        first.frequencies_hz.tolist(),
    ]
    for other in others:
        columns += [
            Column(other.solver, "Hz", ".4f"),
            Column("its mode"),
            Column("differs", "%", "+.3f"),
            Column("MAC", form=".4f"),
        ]
        values += [
            other.frequencies_hz.tolist(),
            (other.pairing.computed + 1).tolist(),
            twin.differences(other).tolist(),
            other.pairing.judged_mac.tolist(),
        ]
    rows = tuple(zip(*values, strict=True))
    lines = []
    for item in twin.solvers:
        lines.append(
            f"{item.solver} {item.version}: {item.result.n_rigid} rigid-body modes, mass "
            f"{item.result.mass:.6g}, {item.wall_s:.1f} s"
        )
        if item.masses:
            lines.append(f"  {item.masses}")
    lines += [f"{solver} did not run: {reason}" for solver, reason in twin.absent]
    return [Table(f"Elastic modes of {twin.name}", tuple(columns), rows), *lines]
