#!/bin/sh
# Makes a golden store: a small campaign run by one commit, as tests/golden keeps one for each format.
# Usage: golden_store.sh COMMIT NAME     (writes tests/golden/NAME.zip; MODETUNE_PYTHON: python)
set -eu
root=$(cd "$(dirname "$0")/.." && pwd)
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
git clone --quiet --shared "$root" "$folder/clone"
git -C "$folder/clone" checkout --quiet "$1"
cp -r "$root/tests/golden/two_mass" "$folder/$2"
cd "$folder/$2"
export PYTHONPATH="$folder/clone/src" MODETUNE_STORE="$folder/$2/store" MODETUNE_NO_PREFECT=1
"${MODETUNE_PYTHON:-python}" -m modetune update campaign.yaml
rm -rf runs/two-mass/report.html runs/two-mass/*.log runs/two-mass/.lock store/locks store/index
find runs -name report.html -delete
"${MODETUNE_PYTHON:-python}" -m zipfile -c "$root/tests/golden/$2.zip" "$folder/$2"
