"""Tests of structures that do not exist: a model with values that no campaign knows, measured."""

from __future__ import annotations

import tempfile
import threading
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import BinaryIO

import numpy as np

from modetune.adapters.calculix.solver import calculix_solver
from modetune.adapters.process import run_process
from modetune.adapters.solver import ModalAnalysis
from modetune.core.modes import ModeSet
from modetune.core.parameters import Parameter
from modetune.core.updating.results import ModalResult

#: A run that takes longer has failed.
TIMEOUT_S = 3600.0


def true_modes(
    write_deck: Callable[[BinaryIO], object],
    parameters: tuple[Parameter, ...],
    truth: Mapping[str, float],
    analysis: ModalAnalysis,
) -> ModeSet:
    """The elastic modes of a model with its true values, by one run of CalculiX; mass-normalised.

    write_deck: writes the deck into a file; truth: relative values by the parameters' names.
    Raises SolverError.
    """
    with tempfile.TemporaryDirectory(prefix="modetune-") as name:
        folder = Path(name)
        deck = folder / "twin.inp"
        with deck.open("wb") as file:
            write_deck(file)
        solver = calculix_solver(deck, parameters)
        solver.render(truth, analysis).write(folder)
        finished = run_process(solver.program.command(1), folder, TIMEOUT_S, threading.Event())
        result = solver.read(truth, analysis, folder, finished.return_code)
    assert isinstance(result, ModalResult)
    return result.elastic


def signed(modes: ModeSet) -> ModeSet:
    """The modes with the largest entry of each shape above zero.

    The solver's sign means nothing; with one of our own the files can be made again anywhere.
    """
    largest = np.argmax(np.abs(modes.mode_shapes), axis=0)
    signs = np.sign(modes.mode_shapes[largest, np.arange(modes.n_modes)])
    return replace(modes, mode_shapes=modes.mode_shapes * signs)


def noisy(modes: ModeSet, frequency: float, shape: float, seed: int) -> ModeSet:
    """The modes as a test would measure them.

    frequency: relative standard deviation of frequencies; shape: that of shape entries, of the
    shape's rms.
    """
    noise = np.random.default_rng(seed)
    shapes = modes.mode_shapes
    rms = np.sqrt(np.mean(shapes**2, axis=0))
    return replace(
        modes,
        frequencies_hz=modes.frequencies_hz
        * (1.0 + frequency * noise.standard_normal(modes.n_modes)),
        mode_shapes=shapes + shape * rms * noise.standard_normal(shapes.shape),
        normalisation="unknown",
    )
