#!/bin/sh
# Installs through apt, where root or sudo is there, what the pictures' tests need: Chromium, in which
# the report is tested, and OSMesa, with which pictures of meshes are drawn without a display.
set -eu
run=""
[ "$(id -u)" = 0 ] || run="sudo -n"
need=""
command -v chromium >/dev/null || need="chromium"
ldconfig -p 2>/dev/null | grep -q -e libEGL -e libOSMesa || need="$need libosmesa6"
[ -n "$need" ] || exit 0
$run apt-get update -qq
# shellcheck disable=SC2086 # a list of packages
DEBIAN_FRONTEND=noninteractive $run apt-get install -y -qq --no-install-recommends $need >/dev/null
