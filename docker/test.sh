#!/usr/bin/env bash
# Runs a small experiment with compose.yaml twice: on one server with one learner, and on two servers with three
# learners, of which one server is stopped in mid-run. Both must end with the same report. Needs the two images, which
# `make docker` builds.
set -euo pipefail
cd "$(dirname "$0")"

source ./test_common.sh

inspect() { docker inspect --format "$1" "${@:2}"; }
results() { find "$work/runs/$1" -name result.json | wc -l; }
sessions() { docker logs "$1" 2>&1 | grep -c 'a session ended' || true; }

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
# Longer than a server that is stopped gives its sessions.
[[algorithm]]
name = "ppo"
architectures = ["ff"]
environments = ["Hopper"]
settings = { episodes = 4000 }
PLAN
cells=10

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

# A session of the first server that goes on: a training, since tests are short.
now() {
    docker exec "$1" bash -c 'exec 3<>/dev/tcp/127.0.0.1/9447; printf "GET /metrics HTTP/1.0\r\n\r\n" >&3; cat <&3' |
        sed -n 's/^perturb_sessions{} \([0-9]*\).*/\1/p'
}
in_training() {
    local before
    before=$(sessions "$1")
    for _ in 1 2 3; do
        [ "$(now "$1")" -gt 0 ] || return 1
        sleep 1
    done
    [ "$(sessions "$1")" = "$before" ]
}
both_used() { [ "$(sessions "${servers[0]}")" -gt 1 ] && [ "$(sessions "${servers[1]}")" -gt 1 ]; }
wait_for "sessions on both servers" both_used
wait_for "a training on the first server" in_training "${servers[0]}"
say "sessions that have ended: $(sessions "${servers[0]}") on the first server, $(sessions "${servers[1]}") on the second"
left=$((cells - $(results broken)))
[ $left -gt 0 ] || fail "the run ended before a server could be stopped"
docker stop "${servers[0]}" >/dev/null
code=$(inspect '{{.State.ExitCode}}' "${servers[0]}")
[ "$code" = 0 ] || fail "the stopped server ended with status $code"
say "the first server is stopped; $left of $cells cells were not done"

learners_end
lost=$(for learner in "${learners[@]}"; do docker logs "$learner" 2>&1; done | grep -c 'lost the server') || true
[ "$lost" -gt 0 ] || fail "no learner noticed that a server was stopped"
say "all learners have ended; they said $lost times that they lost the server, and went on with the other one"
say "sessions in all: $(sessions "${servers[0]}") on the first server, $(sessions "${servers[1]}") on the second"
[ "$(inspect '{{.State.Health.Status}}' "${servers[1]}")" = healthy ] || fail "the second server is no longer healthy"

cmp "$work/runs/whole.html" "$work/runs/broken.html" || fail "the reports differ"
diff -r "$work/runs/whole/report" "$work/runs/broken/report" || fail "the tables differ"
for result in "$work"/runs/whole/cells/*/result.json; do
    cmp "$result" "${result/whole/broken}" || fail "results differ"
done
say "the report, its tables and all results are the same bytes as without the stop"
echo "docker-test passed"
