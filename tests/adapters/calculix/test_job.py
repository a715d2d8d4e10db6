"""The deck of a job: the user's model, and one frequency step with our requests."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from modetune.adapters.calculix.deck import read_deck
from modetune.adapters.calculix.job import check_frequency_step, job_text, spare_unknowns
from modetune.adapters.calculix.structure import CalculixStructure, understand
from modetune.adapters.solver import Analysis, MatrixAnalysis, ModalAnalysis
from modetune.core.errors import ModelError

MODEL = """\
** a comment
*NODE
1, 0, 0, 0
2, 1, 0, 0
3, 1, 1, 0
4, 0, 1, 0
*ELEMENT, TYPE=S4, ELSET=PLATE
1, 1, 2, 3, 4
*MATERIAL, NAME=AL
*ELASTIC
71000., 0.3
*DENSITY
2.8e-9
*SHELL SECTION, ELSET=PLATE, MATERIAL=AL
1.5
"""
PLAIN = MODEL.replace("** a comment\n", "")
MODAL = ModalAnalysis(9, (1, 3), (("E_plate", ("PLATE",)),))
OURS_BEFORE = "*NSET, NSET=MODETUNE_NODES\n1, 3\n*ELSET, ELSET=MODETUNE_ALL\nPLATE\n"
OURS_INSIDE = """\
*FREQUENCY
9
*NODE PRINT, NSET=MODETUNE_NODES, GLOBAL=YES
U
*EL PRINT, ELSET=MODETUNE_ALL, TOTALS=ONLY
ELSE
*EL PRINT, ELSET=PLATE, TOTALS=ONLY
ELSE
*EL PRINT, ELSET=MODETUNE_ALL, TOTALS=ONLY
EMAS
*END STEP
"""


def own_text(model: CalculixStructure, changed: dict[int, str], analysis: Analysis) -> str:
    """The job of a model of four nodes without its spare unknowns."""
    text = job_text(model, changed, analysis)
    if not isinstance(analysis, ModalAnalysis):
        return text
    spare = "\n".join(spare_unknowns(model, analysis.n_modes)) + "\n"
    assert text.startswith(spare)
    return text.removeprefix(spare)


def model_of(folder: Path, text: str) -> CalculixStructure:
    path = folder / "main.inp"
    path.write_text(text)
    return understand(read_deck(path))


def test_a_deck_without_steps_gets_a_plain_frequency_step(tmp_path: Path) -> None:
    text = own_text(model_of(tmp_path, MODEL), {}, MODAL)
    assert text == PLAIN + OURS_BEFORE + "*STEP\n" + OURS_INSIDE


def test_a_matrix_job_asks_for_the_matrices_and_nothing_else(tmp_path: Path) -> None:
    text = own_text(model_of(tmp_path, MODEL), {}, MatrixAnalysis())
    assert text == PLAIN + "*STEP\n*FREQUENCY, SOLVER=MATRIXSTORAGE\n1\n*END STEP\n"


def test_a_frequency_step_keeps_its_boundary_and_loses_its_own_requests(tmp_path: Path) -> None:
    step = (
        "*Step, Perturbation\n** inside\n*Boundary\n1, 1, 6\n*Frequency, Solver=Pardiso, "
        "STORAGE=YES\n20\n*Boundary\n1, 1, 3\n>** more\n*NodeFile\nU, RF\n*EL FILE\nS\n"
        "*Node Print, NSET=NOPE\nU\n*End Step\n"
    )
    model = model_of(tmp_path, MODEL + step)
    above = PLAIN + OURS_BEFORE + "*Step, Perturbation\n*Boundary\n1, 1, 6\n"
    ours, rest = (
        OURS_INSIDE[: OURS_INSIDE.index("*NODE")],
        OURS_INSIDE[OURS_INSIDE.index("*NODE") :],
    )
    ours = ours.replace("*FREQUENCY", "*FREQUENCY, SOLVER=PARDISO, STORAGE=YES")
    held = "*Boundary\n1, 1, 3\n"
    assert own_text(model, {}, MODAL) == above + ours + held + rest
    assert check_frequency_step(model) == []
    stored = own_text(model, {}, MatrixAnalysis())
    assert "*FREQUENCY, SOLVER=MATRIXSTORAGE, STORAGE=YES\n1\n" + held in stored


def test_a_range_of_frequencies_is_left_out_with_a_note(tmp_path: Path) -> None:
    step = "*STEP\n*FREQUENCY\n20, {}\n*END STEP\n"
    for data in ("1., 500.", "1."):
        note, *upper = check_frequency_step(model_of(tmp_path, MODEL + step.format(data)))
        assert "main.inp, line 18: the lower frequency 1 of *FREQUENCY is left out" in note
        assert len(upper) == ("500" in data)
    for data in (", 500.", "0., 500."):
        (note,) = check_frequency_step(model_of(tmp_path, MODEL + step.format(data)))
        assert "line 18: the upper frequency 500 of *FREQUENCY is left out" in note
    stored = step.format("").replace("*FREQUENCY", "*FREQUENCY, SOLVER=MATRIXSTORAGE")
    with pytest.raises(ModelError, match=r"line 17: \*FREQUENCY, SOLVER=MATRIXSTORAGE is of"):
        check_frequency_step(model_of(tmp_path, MODEL + stored))


def test_a_preload_step_stays_without_its_requests_and_later_steps_go(tmp_path: Path) -> None:
    preload = "*STEP, NLGEOM\n*STATIC\n*CLOAD\n2, 1, 5.\n{}*END STEP\n"
    steps = (
        preload.format("*NODE FILE\nU\n*EL PRINT, ELSET=PLATE\nS\n")
        + "*STEP, PERTURBATION\n*FREQUENCY\n5\n*END STEP\n"
        + "*STEP\n*MODAL DYNAMIC\n1., 2.\n*END STEP\n"
    )
    text = own_text(model_of(tmp_path, MODEL + steps), {}, MODAL)
    assert text == (
        PLAIN + preload.format("") + OURS_BEFORE + "*STEP, PERTURBATION\n" + OURS_INSIDE
    )


def test_requests_before_the_first_step_go_too(tmp_path: Path) -> None:
    step = "*OUTPUT, FREQUENCY=2\n*STEP\n*FREQUENCY\n5\n"  # ends without *END STEP
    text = own_text(model_of(tmp_path, MODEL + step), {}, MODAL)
    assert text == PLAIN + OURS_BEFORE + "*STEP\n" + OURS_INSIDE


def test_a_deck_whose_steps_have_no_frequency_is_refused_with_its_line(tmp_path: Path) -> None:
    model = model_of(tmp_path, MODEL + "*STEP\n*STATIC\n*END STEP\n")
    line = MODEL.count("\n") + 1
    message = f"{tmp_path / 'main.inp'}, line {line}: the deck has a *STEP but none with *FREQUENCY"
    with pytest.raises(ModelError, match=re.escape(message)):
        own_text(model, {}, MODAL)


def test_a_frequency_card_outside_a_step_is_refused_with_its_line(tmp_path: Path) -> None:
    model = model_of(tmp_path, MODEL + "*FREQUENCY\n5\n*STEP\n*END STEP\n")
    line = MODEL.count("\n") + 1
    message = f"{tmp_path / 'main.inp'}, line {line}: *FREQUENCY is outside a *STEP"
    with pytest.raises(ModelError, match=re.escape(message)):
        own_text(model, {}, MODAL)


def test_edited_lines_are_in_the_job_wherever_they_stand(tmp_path: Path) -> None:
    for steps in ("", "*STEP\n*FREQUENCY\n5\n*END STEP\n"):
        model = model_of(tmp_path, MODEL + steps)
        place = next(i for i, line in enumerate(model.deck.lines) if line.text == "71000., 0.3")
        text = own_text(model, {place: "80000., 0.3"}, MODAL)
        assert text == (PLAIN.replace("71000.", "80000.") + OURS_BEFORE + "*STEP\n" + OURS_INSIDE)


def test_a_set_of_two_groups_is_asked_for_once(tmp_path: Path) -> None:
    analysis = ModalAnalysis(9, (1, 3), (("a", ("PLATE",)), ("b", ("PLATE",))))
    text = own_text(model_of(tmp_path, MODEL), {}, analysis)
    assert text.count("*EL PRINT, ELSET=PLATE,") == 1


def test_many_nodes_are_wrapped_to_sixteen_a_line(tmp_path: Path) -> None:
    # ccx reads at most sixteen entries of a line.
    text = own_text(model_of(tmp_path, MODEL), {}, ModalAnalysis(9, tuple(range(1, 34))))
    rows = text.partition("NSET=MODETUNE_NODES\n")[2].partition("*")[0].splitlines()
    assert [len(row.split(",")) for row in rows] == [16, 16, 1]
