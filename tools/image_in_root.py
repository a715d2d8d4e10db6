"""Carry out a Dockerfile's steps in plain Debian roots, where there is no container engine.

    sudo python3 tools/image_in_root.py WORK [--host-file PATH ...] [-- COMMAND ...]

WORK is a folder that gets one root a stage (made by debootstrap, kept for the next time as
WORK/base). Host files, such as a proxy's settings for apt and pip, are copied into each root. At
the end COMMAND runs in the last stage as the image's user, through its ENTRYPOINT. What the
Dockerfile of this project uses is known: FROM, RUN, COPY, ENV, USER, WORKDIR, ENTRYPOINT, CMD.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

PROJECT = Path(__file__).resolve().parents[1]
#: Debian releases by the names of their images.
RELEASES = {"debian:12-slim": "bookworm"}
PATH = "/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin"


@dataclass
class Stage:
    """One stage of an image under way."""

    root: Path
    environment: dict[str, str] = field(default_factory=lambda: {"PATH": PATH, "HOME": "/root"})
    user: str = "root"
    folder: str = "/"
    entrypoint: list[str] = field(default_factory=list)
    command: list[str] = field(default_factory=list)

    def run(self, arguments: list[str]) -> None:
        """Run a program in the root. Raises CalledProcessError."""
        inside = 'cd "$0" && exec "$@"'
        switch = ["setpriv", f"--reuid={self.user}", f"--regid={self.user}", "--init-groups"]
        subprocess.run(
            [
                "chroot",
                str(self.root),
                *(switch if self.user != "root" else []),
                "/bin/sh",
                "-c",
                inside,
                self.folder,
                *arguments,
            ],
            env={**self.environment, "DEBIAN_FRONTEND": "noninteractive"},
            check=True,
        )


def instructions(text: str) -> Iterator[tuple[str, str]]:
    """Name and argument of each instruction, continuation lines joined."""
    lines = [line for line in text.splitlines() if not line.lstrip().startswith("#")]
    for line in "\n".join(lines).replace("\\\n", " ").splitlines():
        if line.strip():
            name, _, argument = line.strip().partition(" ")
            yield name.upper(), argument.strip()


def base_root(work: Path, release: str, host_files: list[Path]) -> Path:
    """A minimal root of a Debian release, made once."""
    base = work / "base" / release
    if not (base / "etc" / "debian_version").exists():
        base.parent.mkdir(parents=True, exist_ok=True)
        subprocess.run(
            ["debootstrap", "--variant=minbase", "--include=ca-certificates", release, str(base)],
            check=True,
        )
    for file in (Path("/etc/resolv.conf"), *host_files):
        target = base / file.relative_to("/")
        target.parent.mkdir(parents=True, exist_ok=True)
        if file.is_dir():
            shutil.copytree(file, target, dirs_exist_ok=True)
        else:
            shutil.copyfile(file, target)
    return base


@contextmanager
def mounted(root: Path) -> Iterator[None]:
    """The kernel's folders inside a root."""
    made = []
    try:
        for name in ("proc", "sys", "dev"):
            subprocess.run(["mount", "--rbind", f"/{name}", str(root / name)], check=True)
            subprocess.run(["mount", "--make-rslave", str(root / name)], check=True)
            made.append(root / name)
        yield
    finally:
        for path in reversed(made):
            subprocess.run(["umount", "--recursive", "--lazy", str(path)], check=False)


def copy(stage: Stage, argument: str, stages: dict[str, Stage]) -> None:
    """COPY, from the project or from an earlier stage."""
    words = argument.split()
    source = PROJECT
    if words[0].startswith("--from="):
        source = stages[words.pop(0).removeprefix("--from=")].root
    *names, last = words
    target = stage.root / (Path(stage.folder) / last).relative_to("/")
    for name in names:
        found = source / name.lstrip("/")
        into = target / found.name if last.endswith("/") else target
        into.parent.mkdir(parents=True, exist_ok=True)
        if found.is_dir():
            hidden = shutil.ignore_patterns("__pycache__", ".modetune")
            shutil.copytree(found, into, symlinks=True, dirs_exist_ok=True, ignore=hidden)
        else:
            shutil.copyfile(found, into)


def build(dockerfile: Path, work: Path, host_files: list[Path]) -> Stage:
    """Carry out every step; returns the last stage."""
    stages: dict[str, Stage] = {}
    stage = Stage(Path("/"))
    for name, argument in instructions(dockerfile.read_text()):
        print(f"{name} {argument}", flush=True)  # noqa: T201  # the progress of a tool
        if name == "FROM":
            image, *alias = argument.split()
            label = alias[-1] if alias else str(len(stages))
            root = work / "stages" / label
            if any((root / folder).is_mount() for folder in ("proc", "sys", "dev")):
                raise SystemExit(f"{root} still has the kernel's folders mounted; unmount them")
            shutil.rmtree(root, ignore_errors=True)
            base = base_root(work, RELEASES[image.partition("@")[0]], host_files)
            root.parent.mkdir(parents=True, exist_ok=True)
            subprocess.run(["cp", "--archive", str(base), str(root)], check=True)  # devices too
            stage = stages[label] = Stage(root)
        elif name == "RUN":
            with mounted(stage.root):
                stage.run(["/bin/sh", "-c", argument])
        elif name == "COPY":
            copy(stage, argument, stages)
        elif name == "ENV":
            variable, _, value = argument.partition("=")
            stage.environment[variable] = value.replace("$PATH", stage.environment["PATH"])
        elif name == "USER":
            stage.user = argument
            stage.environment["HOME"] = f"/home/{argument}"
        elif name == "WORKDIR":
            stage.folder = argument
            (stage.root / argument.lstrip("/")).mkdir(parents=True, exist_ok=True)
        elif name in ("ENTRYPOINT", "CMD"):
            words = json.loads(argument)
            stage.entrypoint, stage.command = (
                (words, stage.command) if name == "ENTRYPOINT" else (stage.entrypoint, words)
            )
        else:
            raise SystemExit(f"{dockerfile}: {name} is not known here")
    return stage


def main() -> None:
    parser = argparse.ArgumentParser(description="Carry out a Dockerfile in plain Debian roots.")
    parser.add_argument("work", type=Path)
    parser.add_argument("--host-file", type=Path, action="append", default=[])
    parser.add_argument("--dockerfile", type=Path, default=PROJECT / "Dockerfile")
    own, command = sys.argv[1:], list[str]()
    if "--" in own:
        command = own[own.index("--") + 1 :]
        own = own[: own.index("--")]
    given = parser.parse_args(own)
    if os.geteuid() != 0:
        raise SystemExit("debootstrap and chroot need root")
    stage = build(given.dockerfile, given.work.resolve(), given.host_file)
    with mounted(stage.root):
        stage.run([*stage.entrypoint, *(command or stage.command)])


if __name__ == "__main__":
    main()
