#!/bin/sh
# Sets up what modetune needs: a virtual environment with its Python packages, CalculiX and MUMPS.
# Usage: setup.sh FOLDER REQUIREMENT     (e.g. setup.sh .venv '.[dev]')
# Debian packages are installed where root or sudo is there; else the line to run is printed.
set -eu
venv=$1
requirement=$2
python=${PYTHON:-python3}

need() { # need PACKAGE...: install Debian packages, or say how
    if [ "$(id -u)" = 0 ]; then
        run=""
    elif command -v sudo >/dev/null && { [ -t 0 ] || sudo -n true 2>/dev/null; }; then
        run="sudo"
    else
        echo "modetune needs $*. Please run:  sudo apt-get install $*" >&2
        exit 1
    fi
    if ! command -v apt-get >/dev/null; then
        echo "modetune needs $*, and there is no apt-get here to install it" >&2
        exit 1
    fi
    echo "installing $*"
    $run apt-get update -qq
    DEBIAN_FRONTEND=noninteractive $run apt-get install -y -qq --no-install-recommends "$@" >/dev/null
}

command -v "$python" >/dev/null || need python3 python3-venv
if ! "$python" -c 'import sys; sys.exit(sys.version_info < (3, 11))'; then
    echo "modetune needs Python 3.11 or later; PYTHON=/path/to/python make ... names one" >&2
    exit 1
fi
if [ ! -x "$venv/bin/pip" ]; then
    # Debian keeps the part of venv that brings pip in a package of its own.
    "$python" -c 'import ensurepip' 2>/dev/null || need python3-venv
    "$python" -m venv "$venv"
fi
if ! command -v "${MODETUNE_CCX:-ccx}" >/dev/null; then
    need calculix-ccx
fi
# MUMPS keeps factors on disk that memory does not hold; without it they are refused, in a sentence.
if [ ! -e /usr/include/dmumps_c.h ] && command -v apt-get >/dev/null &&
    { [ "$(id -u)" = 0 ] || sudo -n true 2>/dev/null; }; then
    need libmumps-headers-dev '^libmumps-seq-[0-9.]+$' ||
        echo "MUMPS was not installed: factors that memory does not hold will be refused" >&2
fi
echo "installing modetune's Python packages into $venv"
"$venv/bin/pip" install --quiet --disable-pip-version-check --editable "$requirement"
