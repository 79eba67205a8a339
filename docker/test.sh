#!/usr/bin/env bash
# Runs a small experiment with compose.yaml twice: on one server with one learner, and on two servers with three
# learners, of which one server is stopped in mid-run. Both must end with the same report. Needs the two images, which
# `make docker` builds.
set -euo pipefail
cd "$(dirname "$0")"

source ./test_common.sh

inspect() { docker inspect --format "$1" "${@:2}"; }
results() { find "$work/runs/$1" -name result.json | wc -l; }
sessions() { docker logs "$1" 2>&1 | grep -c 'opening a session' || true; }

# Waits for all learners, which must end well.
learners_end() {
    local codes
    codes=$(compose ps --quiet learner | xargs docker wait)
    [ "$(sort -u <<<"$codes")" = 0 ] || fail "the learners ended with status ${codes//$'\n'/, }"
}

cat >"$work/runs/plan.toml" <<'PLAN'
environments = ["CartPole", "Hopper"]
versions = ["D", "R"]
test_episodes = 50
settings = { episodes = 2000, checkpoint_interval = 20 }
[[algorithm]]
name = "a2c"
architectures = ["ff"]
grid = { learning_rate = [7e-3, 7e-4] }
[[algorithm]]
name = "ppo"
architectures = ["ff"]
PLAN
cells=12

begun=$SECONDS
export PERTURB_NAME=whole
compose up --detach --no-build --scale server=1 --scale learner=1 >/dev/null 2>&1
say "one server, one learner"
learners_end
[ "$(results whole)" = $cells ] || fail "$(results whole) of $cells cells have a result"
say "the report is there, of $cells cells"
compose down --timeout 2 >/dev/null 2>&1

begun=$SECONDS
export PERTURB_NAME=broken
compose up --detach --no-build --scale server=2 --scale learner=3 >/dev/null 2>&1
say "two servers, three learners"
mapfile -t servers < <(compose ps --quiet server)
mapfile -t learners < <(compose ps --quiet learner)
[ ${#servers[@]} = 2 ] && [ ${#learners[@]} = 3 ] || fail "${#servers[@]} servers, ${#learners[@]} learners"
for container in "${servers[@]}" "${learners[@]}"; do
    uid=$(docker exec "$container" id -u)
    [ "$uid" != 0 ] || fail "$(inspect '{{.Name}}' "$container") runs as root"
done
for server in "${servers[@]}"; do
    health=$(inspect '{{.State.Health.Status}}' "$server")
    [ "$health" = healthy ] || fail "$(inspect '{{.Name}}' "$server") is $health"
done
say "nobody is root, both servers are healthy"

# A training that goes on on the first server: its tests at least will miss it.
address=$(inspect '{{range .NetworkSettings.Networks}}{{.IPAddress}}{{end}}' "${servers[0]}")
in_training() {
    local log
    for log in "$work"/runs/broken/cells/*/log.txt; do
        [ "$(tail -n 2 "$log" 2>/dev/null)" = "on http://$address:7447"$'\n'training ] || continue
        [ ! -e "${log%log.txt}training/progress.csv" ] || return 0
    done
    return 1
}
both_used() { [ "$(sessions "${servers[0]}")" -gt 1 ] && [ "$(sessions "${servers[1]}")" -gt 1 ]; }
wait_for "sessions on both servers" both_used
wait_for "a training on the first server" in_training
say "sessions so far: $(sessions "${servers[0]}") on the first server, $(sessions "${servers[1]}") on the second"
left=$((cells - $(results broken)))
[ $left -gt 0 ] || fail "the run ended before a server could be stopped"
docker stop "${servers[0]}" >/dev/null
code=$(inspect '{{.State.ExitCode}}' "${servers[0]}")
[ "$code" = 0 ] || fail "the stopped server ended with status $code"
say "the first server is stopped; $left of $cells cells were not done"

learners_end
lost=$(grep -l 'lost the server' "$work"/runs/broken/cells/*/log.txt | wc -l)
[ "$lost" -gt 0 ] || fail "no cell noticed that a server was stopped"
say "all learners have ended; cells that lost their server and went on with the other one: $lost"
say "sessions in all: $(sessions "${servers[0]}") on the first server, $(sessions "${servers[1]}") on the second"
[ "$(inspect '{{.State.Health.Status}}' "${servers[1]}")" = healthy ] || fail "the second server is no longer healthy"

cmp "$work/runs/whole.html" "$work/runs/broken.html" || fail "the reports differ"
diff -r "$work/runs/whole/report" "$work/runs/broken/report" || fail "the tables differ"
for result in "$work"/runs/whole/cells/*/result.json; do
    cmp "$result" "${result/whole/broken}" || fail "results differ"
done
say "the report, its tables and all results are the same bytes as without the stop"
echo "docker-test passed"
