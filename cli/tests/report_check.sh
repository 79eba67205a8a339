#!/bin/sh
# Makes the report of a small experiment and checks it in headless Chromium: once with every kind of section, and once
# with missing results and pictures.
#
#     cli/tests/report_check.sh [DIRECTORY]
#
# DIRECTORY gets the pages and screenshots of them; it is deleted first (default target/report-check). Variables:
# PROGRAMS is the folder of `perturb` and `perturb-server` (default target/release), and CHROMIUM is the browser. The
# exit status is 1 if a page is faulty.
set -eu

: "${PROGRAMS:=target/release}" "${CHROMIUM:=chromium}" "${OPENBLAS_NUM_THREADS:=1}"
export OPENBLAS_NUM_THREADS
here=$(dirname "$0")/report_check
out=${1:-target/report-check}

check() {
    "$PROGRAMS/perturb" report "$1" --html "$1.html" >/dev/null
    python3 "$here/check.py" "$CHROMIUM" "$1" "$1.html" "$1-pictures"
}

rm -rf "$out"
mkdir -p "$out"
# The plan has cells that fail.
status=0
"$PROGRAMS/perturb" run "$here/plan.toml" --out "$out/whole" 2>"$out/run.log" || status=$?
if [ "$status" != 1 ] || ! grep -q '6 of 42 cells failed' "$out/run.log"; then
    echo "perturb run ended with $status, expected 1 and 6 of 42 cells failed; see $out/run.log" >&2
    exit 1
fi
"$PROGRAMS/perturb" heatmap "$out/whole" --grid 10 --episodes 2 >"$out/heatmap.log"
check "$out/whole"

cp -a "$out/whole" "$out/gaps"
rm "$out"/gaps/cells/Pendulum-ppo-ff-R-*/result.json
rm "$out"/gaps/heatmaps/MountainCar-ppo-ff-E-*.csv "$out"/gaps/heatmaps/Pendulum-a2c-*.csv "$out"/gaps/report/*-heatmap-*
rm "$out"/gaps/cells/MountainCar-*/training/monitor.csv
check "$out/gaps"
