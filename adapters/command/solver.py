"""Any program that a command line starts, behind the solver seam: frequencies and shapes."""

from __future__ import annotations

import hashlib
import os
import re
import sys
import tempfile
import threading
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from modetune.adapters.command.deck import EditedTemplate, read_deck
from modetune.adapters.command.reader import UserReader, load_reader
from modetune.adapters.command.settings import ARGUMENTS, CommandSettings
from modetune.adapters.process import log_tail, read_log, run_process
from modetune.adapters.regular_file import read_errors, read_regular
from modetune.adapters.solver import (
    FOLDER,
    Analysis,
    Capabilities,
    Command,
    ModalAnalysis,
    Rendered,
    Solver,
)
from modetune.adapters.test_files.measurements import read_computed
from modetune.core.errors import (
    CampaignError,
    ModelError,
    NoResult,
    SolverCrashed,
    SolverMissing,
    SolverRejected,
)
from modetune.core.modes import ModeSet, Normalisation, dof_name, mode_set
from modetune.core.near_names import listed
from modetune.core.parameters import Parameter
from modetune.core.storage.keys import Json
from modetune.core.updating.job_results import ModalResult

#: What a version looks like in what a program prints of itself.
VERSION = re.compile(r"\b\d+(?:\.\w+)+")
#: How long a program may take to print its version, seconds: some fetch a licence first.
VERSION_S = 120.0


@dataclass(frozen=True)
class CommandProgram:
    """A program as a campaign describes it; reader: of its results, None for a file's form."""

    settings: CommandSettings
    deck_name: str
    reader: UserReader | None
    folder: Path

    #: Raised by hand when the same output is read to other numbers.
    reader_version = 1
    capabilities = Capabilities(strain_energies=False, matrices=False)

    @property
    def name(self) -> str:
        return self.settings.name

    @cached_property
    def _version(self) -> str:
        asked = self.settings.version
        if isinstance(asked, str):
            return asked
        with tempfile.TemporaryDirectory(prefix="modetune-") as name:
            command = Command(self._arguments(asked, 1))
            finished = run_process(command, Path(name), VERSION_S, threading.Event())
            text = read_log(Path(name)).strip()
        found = VERSION.search(text)
        # Some programs print their version and end with a code of failure, for example ccx.
        if not found and (finished.return_code not in self.settings.exit_codes or not text):
            raise SolverMissing(
                f"`{' '.join(command.arguments)}` ended with code {finished.return_code} and told "
                f"no version of {self.name} (`version` under `model.command`): {text[-200:]}"
            )
        return found[0] if found else text.splitlines()[0][:80]

    def version(self) -> str:
        return self._version

    def render(self, deck: EditedTemplate, analysis: Analysis) -> Rendered:
        asked = self._asked(analysis)
        files = deck.template.filled(deck.numbers, asked.n_modes)
        main, *others = deck.template.files
        settings = self.settings
        content: Json = {
            "solver": self.name,
            "version": self.version(),
            "reader": [self.reader_version, self.reader.digest if self.reader else ""],
            "deck": hashlib.sha256(files[main.name]).hexdigest(),
            "inputs": {file.name: hashlib.sha256(files[file.name]).hexdigest() for file in others},
            "command": list(settings.run),
            "results": [settings.results, settings.normalisation, *settings.components],
            "n_modes": asked.n_modes,
            "nodes": list(asked.nodes),
            **self._surroundings,
        }
        return Rendered.of_texts(content, files)

    @cached_property
    def _surroundings(self) -> dict[str, Json]:
        """What else decides the results: digests of files and of environment variables.

        Nothing where there are none, so that keys are as before. Raises ModelError.
        """
        found: dict[str, Json] = {}
        given = [word.rpartition("=")[2] for word in self.settings.run if "{" not in word]
        named = [word for word in given if (self.folder / word).is_file()]
        files = {
            name: digest_of(self.folder / name)
            for name in dict.fromkeys((*named, *self.settings.depends))
            if name not in (self.deck_name, *self.settings.inputs)
        }
        if files:
            found["depends"] = files
        if self.settings.environment:
            found["environment"] = {
                name: hashlib.sha256(os.environ[name].encode()).hexdigest()
                if name in os.environ
                else ""
                for name in self.settings.environment
            }
        return found

    def command(self, threads: int) -> Command:
        arguments = self._arguments(self.settings.run, threads)
        return Command(arguments, (("OMP_NUM_THREADS", str(threads)),))

    def read(
        self, deck: EditedTemplate, analysis: Analysis, folder: Path, return_code: int
    ) -> ModalResult:
        self._judge(deck, folder, return_code)
        path = folder / self.settings.results
        found = self.reader.read(folder) if self.reader else read_results(path)
        return asked_modes(
            found,
            self._asked(analysis),
            self.settings.components,
            self.settings.normalisation,
            f"what {self.reader.name} read in {folder}" if self.reader else str(path),
        )

    def _asked(self, analysis: Analysis) -> ModalAnalysis:
        assert isinstance(analysis, ModalAnalysis)
        most = self.settings.most_modes
        return replace(analysis, n_modes=min(analysis.n_modes, most)) if most else analysis

    def _arguments(self, arguments: tuple[str, ...], threads: int) -> tuple[str, ...]:
        words = (self.deck_name, Path(self.deck_name).stem, str(threads), FOLDER, sys.executable)
        named = dict(zip(ARGUMENTS, words, strict=True))
        return tuple(
            re.sub(r"\{(\w+)\}", lambda found: named[found[1]], item) for item in arguments
        )

    def _judge(self, deck: EditedTemplate, folder: Path, return_code: int) -> None:
        """Raise SolverRejected or SolverCrashed unless the run came to a good end."""
        wanted, fatal = (
            [re.compile(text) for text in texts]
            for texts in (self.settings.success, self.settings.fatal)
        )
        missing = set(wanted)
        for path, line in self._lines(folder):
            if any(pattern.search(line) for pattern in fatal):
                raise SolverRejected(
                    f"{self.name} refused {deck.template.path} (job in {folder}): {path.name} "
                    f"says:\n  | {line.strip()}"
                )
            missing -= {pattern for pattern in missing if pattern.search(line)}
        if return_code in self.settings.exit_codes and not missing:
            return
        lacks = " and ".join(f"`{pattern.pattern}`" for pattern in wanted if pattern in missing)
        without = f" and without {lacks} in {', '.join(self.settings.logs)}" if lacks else ""
        raise SolverCrashed(
            f"{self.name} ended in {folder} with code {return_code}{without}\n{log_tail(folder)}"
        )

    def _lines(self, folder: Path) -> Iterator[tuple[Path, str]]:
        """Yield the lines of a job's logs."""
        if not self.settings.success and not self.settings.fatal:
            return
        named = (path for name in self.settings.logs for path in sorted(folder.glob(name)))
        for path in dict.fromkeys(named):
            try:
                text = read_regular(path).decode("utf-8", "replace")
            except OSError:  # a folder of that name, or gone
                continue
            yield from ((path, line) for line in text.splitlines())


def command_solver(
    deck: Path, parameters: tuple[Parameter, ...], settings: CommandSettings
) -> Solver:
    """Return a program for a deck. Raises ModelError where the two do not fit."""
    version = () if isinstance(settings.version, str) else settings.version
    problems = [
        f"{deck}: `model.command` has {{{name}}} in a command line; there are "
        f"{', '.join(f'{{{known}}}' for known in ARGUMENTS)}"
        for item in (*settings.run, *version)
        for name in re.findall(r"\{(\w+)\}", item)
        if name not in ARGUMENTS
    ]
    for text in (*settings.success, *settings.fatal):
        try:
            re.compile(text)
        except re.error as error:
            problems.append(f"{deck}: `{text}` under `model.command` is not a pattern: {error}")
    problems += [
        f"{deck}: `depends` under `model.command` names {name}, which is not there"
        for name in settings.depends
        if not (deck.parent / name).exists()
    ]
    if problems:
        raise ModelError("\n".join(problems))
    reader = load_reader(settings.reader, deck.parent) if settings.reader else None
    model = read_deck(deck, settings, parameters)
    return Solver(model, CommandProgram(settings, deck.name, reader, deck.parent))


def digest_of(path: Path) -> str:
    """Return a digest of a file, or of the files in a folder but byte code. Raises ModelError."""
    inside = sorted(path.rglob("*")) if path.is_dir() else [path]
    whole = hashlib.sha256()
    for item in inside:
        if item.is_dir() or "__pycache__" in item.parts:
            continue
        with read_errors(item, ModelError):
            content = hashlib.sha256(read_regular(item)).digest()
        whole.update(f"{item.relative_to(path.parent).as_posix()}\0".encode() + content)
    return whole.hexdigest()


REMEDY = "under `model.command`"


def read_results(path: Path) -> ModeSet:
    """Return the modes of a file, at all of its nodes. Raises NoResult, SolverRejected."""
    if not path.exists():
        there = ", ".join(sorted(item.name for item in path.parent.iterdir())) or "nothing"
        raise NoResult(
            f"the program left no {path.name} in {path.parent} (`results` {REMEDY}); there is: "
            f"{there}"
        )
    try:
        return read_computed(path)
    except CampaignError as error:
        raise NoResult(f"{path} holds no modes that can be read: {error}") from error


def asked_modes(
    found: ModeSet,
    analysis: ModalAnalysis,
    components: tuple[int, ...],
    normalisation: Normalisation,
    place: str,
) -> ModalResult:
    """Return the lowest modes of those that were found, at the nodes of an analysis.

    place: of the results, for messages. Raises SolverRejected where there are not enough modes or
    nodes: the same deck would give the same again.
    """
    if found.n_modes < analysis.n_modes:
        raise SolverRejected(
            f"{place} holds {found.n_modes} modes where {analysis.n_modes} were asked for; write "
            "{n_modes} into the deck where it says how many, or give `most_modes` "
            f"{REMEDY} where the deck has no more"
        )
    rows = {
        dof: row
        for row, dof in enumerate(zip(found.nodes.tolist(), found.components.tolist(), strict=True))
    }
    wanted = [(node, component) for node in analysis.nodes for component in components]
    missing = [dof_name(dof) for dof in wanted if dof not in rows]
    if missing:
        raise SolverRejected(
            f"{place} has no shape at {listed(missing, 5)} "
            f"({len(missing)} of {len(wanted)} that were asked for, {len(rows)} are there); let "
            "the program write all nodes of the file of `nodes`, held ones as zeros, or give "
            f"`components` {REMEDY}"
        )
    order = np.argsort(found.frequencies_hz, kind="stable")[: analysis.n_modes]
    frequencies = found.frequencies_hz[order]
    shapes = np.real(found.mode_shapes[[rows[dof] for dof in wanted]][:, order])
    told = found.normalisation
    unknown = np.full(order.size, np.nan)
    return ModalResult(
        eigenvalues=(2.0 * np.pi * frequencies) ** 2,
        modes=mode_set(
            frequencies,
            shapes.reshape(len(wanted), order.size),
            [node for node, _ in wanted],
            [component for _, component in wanted],
            normalisation=normalisation if told == "unknown" else told,
        ),
        groups=(),
        strain_energies=np.zeros((0, order.size)),
        total_strain_energy=unknown,
        mass=float("nan"),
    )
