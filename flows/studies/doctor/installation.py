"""The installation: packages, machine, site, servers and store, one line of the report each."""

from __future__ import annotations

import os
import platform
import re
import shutil
import socket
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from getpass import getuser
from importlib import metadata
from pathlib import Path
from typing import Annotated, Literal, get_args

from packaging.requirements import Requirement

from modetune.core.algebra import mumps
from modetune.core.errors import ModetuneError
from modetune.core.storage.files import check_writable
from modetune.core.storage.locks import FileLock
from modetune.flows.campaign.campaign import cores
from modetune.flows.campaign.schema import STORE_REMEDY, STORE_VARIABLE
from modetune.flows.campaign.site import RunSection, site_path
from modetune.flows.jobs.prefect_server import (
    configured_server,
    is_ours,
    running_address,
    server_home,
)
from modetune.flows.report.tables import Column

State = Literal["passed", "failed", "not available"]
STATES: tuple[State, ...] = get_args(State)


@dataclass(frozen=True, slots=True)
class DoctorLine:
    """One line of the report.

    topic: the machine or a solver. said: the finding, or the reason. remedy: the action to take,
    empty if none. seconds: duration of the test.
    """

    topic: Annotated[str, Column("of")]
    item: Annotated[str, Column("what")]
    state: Annotated[State, Column("state")]
    said: Annotated[str, Column("found")]
    remedy: Annotated[str, Column("what to do")] = ""
    seconds: Annotated[float, Column("time", "s", ".1f")] = 0.0

    @property
    def text(self) -> str:
        """The line as printed."""
        more = f"; {self.remedy}" if self.remedy else ""
        return f"{self.state:<13} {self.topic}: {self.item}: {self.said}{more}"


#: Receives each line at once.
Tell = Callable[[DoctorLine], None]


def without_names(line: DoctorLine) -> DoctorLine:
    """Return the line without home folder, user and host, so that the report can be sent."""
    return replace(line, said=_anonymous(line.said), remedy=_anonymous(line.remedy))


def _anonymous(text: str) -> str:
    text = text.replace(str(Path.home()), "~")
    for name, shown in ((getuser(), "USER"), (socket.gethostname(), "HOST")):
        if len(name) > 1:
            text = re.sub(rf"(?<![\w.-]){re.escape(name)}(?![\w-])", shown, text)
    return text


HERE = "machine"
#: Extras for users; `all` joins them, `dev` is for work on modetune.
EXTRAS = ("calculix", "pictures", "studies", "cluster")
#: Free disk space that a campaign of a medium-sized model can need, in bytes.
LEAST_DISK = 5e9
#: Variables with the addresses of licence servers; values are not reported.
LICENCE_VARIABLES = ("MSC_LICENSE_FILE", "LM_LICENSE_FILE", "SPLM_LICENSE_SERVER",
                     "SALT_LICENSE_SERVER", "UGS_LICENSE_SERVER")  # fmt: skip

Found = tuple[State, str, str]


def look_around(tell: Tell, working: Callable[[str], None]) -> None:
    """Report the installation and the site."""
    looks: list[tuple[str, Callable[[], Found]]] = [
        ("Python", _python),
        ("packages", lambda: _packages("")),
        *((f"extra {name}", lambda name=name: _packages(name)) for name in EXTRAS),
        ("factors on disk", _mumps),
        ("cores, memory", _machine),
        ("disk", _disk),
        ("site file", _site),
        ("licences", _licences),
        ("Prefect server", _server),
        ("store", _store),
    ]
    for item, look in looks:
        working(f"{HERE}: {item}")
        started = time.monotonic()
        try:
            state, text, remedy = look()
        except ModetuneError as error:
            state, text, remedy = "failed", str(error), ""
        tell(DoctorLine(HERE, item, state, text, remedy, time.monotonic() - started))


def _python() -> Found:
    system = f"{platform.system()} {platform.release()}, {platform.machine()}"
    return "passed", f"{platform.python_version()}; modetune {_version('modetune')}; {system}", ""


def _version(name: str) -> str:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return ""


def _packages(extra: str) -> Found:
    """Compare the installed packages with the requirements of modetune or of an extra."""
    installed, wrong, missing = [], [], []
    for text in metadata.requires("modetune") or ():
        wanted = Requirement(text)
        if wanted.marker is not None and not wanted.marker.evaluate({"extra": extra}):
            continue
        if extra and (wanted.marker is None or wanted.marker.evaluate({"extra": ""})):
            continue
        version = _version(wanted.name)
        if not version:
            missing.append(wanted.name)
        elif not wanted.specifier.contains(version, prereleases=True):
            wrong.append(f"{wanted.name} {version} is not {wanted.specifier}")
        else:
            installed.append(f"{wanted.name} {version}")
    remedy = f"pip install 'modetune[{extra}]'" if extra else "pip install modetune"
    message = ", ".join(installed)
    if wrong or (missing and not extra):
        absent = [f"{name} is not installed" for name in missing]
        return "failed", "; ".join([*wrong, *absent]), remedy
    if missing:
        return "not available", f"{', '.join(missing)} not installed", remedy
    return "passed", message, ""


def _mumps() -> Found:
    if mumps.is_available():
        return "passed", "MUMPS, for models whose factors exceed the memory", ""
    return "not available", "MUMPS is not installed", mumps.REMEDY


def _machine() -> Found:
    pages = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    free = os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    text = f"{cores()} of {os.cpu_count()} cores, {pages / 1e9:.1f} GB, {free / 1e9:.1f} GB unused"
    return "passed", text, ""


def _disk() -> Found:
    free = shutil.disk_usage(_store_folder(existing=True)).free
    text = f"{free / 1e9:.1f} GB free below the store"
    if free < LEAST_DISK:
        return "failed", text, f"free some space, or name another disk with {STORE_VARIABLE}"
    return "passed", text, ""


def _site() -> Found:
    run = RunSection().on_site()  # raises where it cannot be read
    if not site_path().is_file():
        return "not available", "no site file; campaigns run on this machine", ""
    return "passed", f"{site_path()}: jobs run by {run.engine}", ""


def _licences() -> Found:
    run = RunSection().on_site()
    named = [name for name in LICENCE_VARIABLES if os.environ.get(name)]
    counted = [f"{count} of {name}" for name, count in run.licences.items()]
    if not named and not counted:
        return (
            "not available",
            "the environment names no licence server, and the site file limits no licences",
            "only commercial solvers need them",
        )
    texts = [f"{', '.join(named)} set"] if named else []
    return (
        "passed",
        "; ".join([*texts, *(["limits: " + ", ".join(counted)] if counted else [])]),
        "",
    )


def _server() -> Found:
    configured = configured_server()
    if configured is not None:
        answer = configured.answer()
        if answer == "ready":
            return "passed", f"{configured.address.url} answers", ""
        return "failed", configured.describe(answer), ""
    address = running_address(server_home())
    if address is None or not is_ours(address.url):
        return "not available", "not running; the first command that needs it starts it", ""
    return "passed", f"running at {address.url.removesuffix('/api')}", ""


def _store() -> Found:
    """Test that the store can be written and locked, and report its size."""
    folder = _store_folder()
    new = not folder.exists()
    try:
        check_writable(folder, STORE_REMEDY)
        with FileLock(folder / ".doctor.lock") as lock:
            if not lock.take():
                return "passed", f"{folder}: another test of it is running", ""
            second = FileLock(folder / ".doctor.lock")
            twice = second.take()
            second.release()
            lock.remove()
    finally:
        for made in (folder, folder.parent) if new else ():
            if made.is_dir() and not any(made.iterdir()):
                made.rmdir()
    if twice:
        return (
            "failed",
            f"{folder}: a lock can be taken twice, so two campaigns could run the same job",
            f"name a folder on another file system with {STORE_VARIABLE}",
        )
    if new:
        return "passed", f"{folder}: writable, locks work; created when needed", ""
    files = [path for path in folder.rglob("*") if path.is_file()]
    size = sum(path.stat().st_size for path in files)
    text = f"{folder}: {len(files)} files, {size / 1e6:.1f} MB; writable, locks work"
    return "passed", text, ""


def _store_folder(existing: bool = False) -> Path:
    """Return the store of campaigns in this folder; existing: its first parent that exists."""
    folder = Path(os.environ.get(STORE_VARIABLE) or Path(".modetune") / "store").absolute()
    while existing and not folder.is_dir():
        folder = folder.parent
    return folder
