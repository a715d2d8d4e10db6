"""Why a campaign that reads well cannot be run: cores, licences, methods; each with its line."""

from __future__ import annotations

from typing import get_args

from modetune.adapters.solver import Solver
from modetune.adapters.yaml_file import YamlFile
from modetune.flows.campaign.parameter_section import targets_of
from modetune.flows.campaign.schema import BY_NAME, NO_TEST, CampaignFile, SolverName
from modetune.flows.campaign.self_test import not_confirmed
from modetune.flows.campaign.site import RunSection


def core_problems(source: YamlFile, run: RunSection, cores: int) -> list[str]:
    """Jobs in parallel times threads of each must not be more than the machine's cores."""
    wanted = max(run.parallel, 1) * max(run.threads, 1)
    if wanted <= cores or not run.here:
        return []
    return [
        f"{source.where(('run',))}: run: {max(run.parallel, 1)} jobs of {max(run.threads, 1)} "
        f"threads need {wanted} cores, this machine has {cores}; lower `parallel` or `threads`, "
        "or leave them out"
    ]


def target_problems(source: YamlFile, file: CampaignFile) -> list[str]:
    """Parameters that name nothing, on a solver that needs to be told what they scale."""
    if file.model.solver not in get_args(SolverName) or file.model.solver in BY_NAME:
        return []
    return [
        f"{source.where(('parameters', place))}: parameters.{place}: {item.quantity} needs "
        f"{targets_of(item.quantity)}; it has none"
        for place, item in enumerate(file.parameters)
        if item.by() == "placeholder" and item.quantity != "variable"
    ]


def licence_problems(source: YamlFile, file: CampaignFile) -> list[str]:
    """A licence that no solver has would limit nothing, without a word."""
    models = [item.model for item in file.configurations] + ([file.model] if file.model else [])
    known = [*get_args(SolverName), *(model.program for model in models)]
    unknown = sorted(set(file.run.licences) - set(known))
    if not unknown:
        return []
    return [
        f"{source.where(('run', 'licences'))}: run.licences names {', '.join(unknown)}; licences "
        f"go by the solver's name: {', '.join(dict.fromkeys(known))}"
    ]


def method_problems(source: YamlFile, file: CampaignFile, solver: Solver) -> list[str]:
    """Why the campaign's sensitivity method is unavailable."""
    method, has = file.sensitivity.method, solver.program.capabilities
    shapes = file.residuals.with_shapes or file.residuals.modal_strain is not None
    place = source.where(("sensitivity", "method"))
    offered = {
        "strain_energy": has.strain_energies,
        "semi_analytic": solver.offers.matrices,
        "solver": has.shape_sensitivities if shapes else has.frequency_sensitivities,
    }
    if not offered.get(method, True):
        why = not_confirmed(solver) if method == "semi_analytic" and has.matrices else ""
        said = f"{solver.program.name} does not offer {method} here"
        return [f"{place}: {why or said}; use `auto`"]
    if file.model.eigensolver == "solver" and file.update.confirm == "matrices":
        where = source.where(("update", "confirm"))
        return [
            f"{where}: update.confirm: matrices confirms modes that come from matrices, and "
            "`model.eigensolver: solver` takes the solver's own; leave one of the two out"
        ]
    if file.model.eigensolver not in ("auto", "solver"):
        from modetune.flows.campaign.matrix_plan import unsuitable

        where = f"{source.where(('model', 'eigensolver'))}: eigensolver {file.model.eigensolver}"
        reason = (
            "before there is a test the modes are the solver's own"
            if file.test.modes == NO_TEST
            else unsuitable(solver, file.parameter_set().parameters, method)
        )
        if reason is not None:
            return [f"{where}: {reason}; use `auto` or solver"]
    if method == "semi_analytic" and shapes and not solver.deck.summary.solid_shapes:
        return [
            f"{place}: shape sensitivities from matrices need a model of solids without dependent "
            "nodes; use `auto` or finite_difference"
        ]
    if method != "strain_energy":
        return []
    if shapes:
        return [f"{place}: strain energies give no shape sensitivities; use `auto`"]
    return [
        f"{place}: the stiffness is not proportional to {item.name} "
        f"({solver.deck.preload() or item.quantity}); use `auto`"
        for item in file.parameter_set().parameters
        if not solver.deck.problems((item,)) and not solver.deck.energy_sets(item)
    ]
