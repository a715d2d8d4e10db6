"""Tests of structures that do not exist: a model with values that no campaign knows, measured."""

from __future__ import annotations

import tempfile
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import BinaryIO

import numpy as np

from modetune.adapters.calculix.solver import calculix_solver
from modetune.adapters.process import run_process
from modetune.adapters.solver import ModalAnalysis
from modetune.core.measurement.measurement import MeasuredFrfs
from modetune.core.measurement.response_functions import Complexes
from modetune.core.modes import Floats, ModeSet
from modetune.core.parameters import Parameter
from modetune.core.updating.job_results import ModalResult

#: A run that takes longer has failed.
TIMEOUT_S = 3600.0


def true_modes(
    write_deck: Callable[[BinaryIO], object],
    parameters: tuple[Parameter, ...],
    truth: Mapping[str, float],
    analysis: ModalAnalysis,
    rigid: bool = False,
) -> ModeSet:
    """The elastic modes of a model with its true values, by one run of CalculiX; mass-normalised.

    write_deck: writes the deck into a file; truth: relative values by the parameters' names; rigid:
    whether rigid modes precede them. Raises SolverError.
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
    return result.modes if rigid else result.elastic


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


def accelerances(
    lines_hz: Floats, modes: ModeSet, shapes: Floats, force: Floats, damping: float
) -> Complexes:
    """(n_lines, n_sensors), (m/s^2)/N, of mass-normalised modes in mm and t.

    shapes: (n_modes, n_sensors), motion along the sensors; force: (n_modes,), that along the
    force; damping: of every mode, a share of the critical one.
    """
    lam, omega = modes.eigenvalues, 2.0 * np.pi * lines_hz[:, None]
    gains = 1.0 / (lam - omega**2 + 2j * damping * np.sqrt(lam) * omega)
    return np.asarray(-1e-3 * omega**2 * ((gains * force) @ shapes.T))  # 1/t is 1e-3/kg


def noisy_functions(
    lines_hz: Floats,
    values: Complexes,
    sensors: Sequence[tuple[int, int]],
    shakers: Sequence[tuple[int, int]],
    noise: float,
    random: np.random.Generator,
) -> MeasuredFrfs:
    """Accelerances as a lab measures them, by shaker and then by sensor.

    values: (n_lines, n_shakers * n_sensors), (m/s^2)/N; sensors, shakers: number of the point and
    component; noise: standard deviation, of each function's rms.
    """
    parts = random.standard_normal(values.shape) + 1j * random.standard_normal(values.shape)
    rms = np.sqrt(np.mean(np.abs(values) ** 2, axis=0))
    (nodes, components), (forced, along) = np.transpose(sensors), np.transpose(shakers)
    return MeasuredFrfs(
        kind="accelerance",
        frequencies_hz=lines_hz,
        values=values + noise * rms * parts / np.sqrt(2.0),
        nodes=np.tile(nodes, len(shakers)),
        components=np.tile(components, len(shakers)),
        signs=np.ones(values.shape[1]),
        reference_nodes=np.repeat(forced, len(sensors)),
        reference_components=np.repeat(along, len(sensors)),
        reference_signs=np.ones(values.shape[1]),
        coherences=np.zeros((0, 0)),
    )
