#!/bin/sh
# Trains every pair of algorithm and architecture on every environment, sixty short runs, and tests each on version D.
#
#     cli/tests/all_pairs.sh [EPISODES [DIRECTORY [JOBS]]]
#
# EPISODES is the number of episodes of each training (default 300). DIRECTORY is the folder of the runs; a run replaces
# the run of the same pair and environment from an earlier call (default target/all-pairs). JOBS is the number of
# simultaneous runs (default 2; a learner keeps one core busy). The script prints a line for each run. The exit status
# is 1 if a run failed or a number in its logs or its result is not finite. The output of each run is in
# DIRECTORY/<environment>-<algorithm>-<architecture>/log. Variables: PROGRAMS is the folder of `perturb` and
# `perturb-server` (default target/release), TEST_EPISODES is the number of test episodes (default 100), and PAIRS and
# ENVIRONMENTS select what is trained.
set -eu

: "${PAIRS:=a2c:ff a2c:rc ppo:ff ppo:rc epopt-a2c:ff epopt-a2c:rc epopt-ppo:ff epopt-ppo:rc rl2-a2c:rc rl2-ppo:rc}"
: "${ENVIRONMENTS:=CartPole MountainCar Acrobot Pendulum HalfCheetah Hopper}"
FORMAT='%-12s %-10s %-4s %9s %12s %8s  %s\n'

: "${PROGRAMS:=target/release}" "${TEST_EPISODES:=100}" "${OPENBLAS_NUM_THREADS:=1}"
export PROGRAMS TEST_EPISODES OPENBLAS_NUM_THREADS

# Prints one number of a result.
figure() {
    sed -n "s/^ *\"$1\": *\([^,]*\),*$/\1/p" "$2"
}

# Tests that no value in CSV files is NaN or infinite. Empty values are allowed, because they were not measured.
finite() {
    ! grep -qiE '(^|,)[-+]?(nan|inf)' "$@"
}

# Trains and tests one pair in one environment, and prints a line with the results.
one() {
    algorithm=$1 architecture=$2 environment=$3 episodes=$4
    run=$5/$environment-$algorithm-$architecture
    rm -rf "$run"
    mkdir -p "$run"
    begun=$(date +%s) verdict=ok success=- mean_return=-
    if ! "$PROGRAMS/perturb" train --env "$environment" --algorithm "$algorithm" --architecture "$architecture" \
        --episodes "$episodes" --workers 1 --out "$run/run" >"$run/log" 2>&1; then
        verdict='TRAINING FAILED'
    elif ! "$PROGRAMS/perturb" evaluate --checkpoint "$run/run" --versions D --episodes "$TEST_EPISODES" \
        --workers 1 --json "$run/result.json" >>"$run/log" 2>&1; then
        verdict='TEST FAILED'
    else
        success=$(figure success_percent "$run/result.json")
        mean_return=$(figure mean_return "$run/result.json")
        number='^-?[0-9]+(\.[0-9]+)?(e[-+]?[0-9]+)?$'
        if ! finite "$run/run/monitor.csv" "$run/run/progress.csv" ||
            ! echo "$success" | grep -qE "$number" || ! echo "$mean_return" | grep -qE "$number"; then
            verdict='NOT FINITE'
        else
            success=$(printf %.1f "$success") mean_return=$(printf %.2f "$mean_return")
        fi
    fi
    # shellcheck disable=SC2059 # the format is a constant of this script
    printf "$FORMAT" "$environment" "$algorithm" "$architecture" "$success" "$mean_return" \
        $(($(date +%s) - begun)) "$verdict" | tee "$run/line"
}

if [ "${1-}" = --one ]; then
    shift
    one "$@"
    exit
fi

episodes=${1:-300} directory=${2:-target/all-pairs} jobs=${3:-2}
for number in "$episodes" "$jobs" "$TEST_EPISODES"; do
    case $number in
    '' | *[!0-9]* | 0*) echo "$number is not a number above 0; usage: $0 [EPISODES [DIRECTORY [JOBS]]]" >&2; exit 2 ;;
    esac
done
for program in perturb perturb-server; do
    [ -x "$PROGRAMS/$program" ] || { echo "$PROGRAMS/$program is missing: run make build first" >&2; exit 2; }
done
mkdir -p "$directory"
# shellcheck disable=SC2059
printf "$FORMAT" environment algorithm arch 'success %' 'mean return' seconds ''
rm -f "$directory"/*/line
wanted=0
for environment in $ENVIRONMENTS; do
    for pair in $PAIRS; do
        wanted=$((wanted + 1))
    done
done
for environment in $ENVIRONMENTS; do
    for pair in $PAIRS; do
        printf '%s\n' "${pair%:*}" "${pair#*:}" "$environment" "$episodes" "$directory"
    done
done | tr '\n' '\0' | xargs -0 -n 5 -P "$jobs" "$0" --one

good=$(cat "$directory"/*/line | grep -c ' ok$' || true)
echo "$good of $wanted runs went well"
[ "$good" = "$wanted" ]
