#!/usr/bin/env bash
# Runs a small experiment with compose.yaml twice: first on one server with one learner, then on two servers with three
# learners. In the second run one of the servers is stopped. Both runs must end with the same report. Then runs an
# experiment with two tasks from a mounted folder. Needs the two images, which `make docker` builds.
set -euo pipefail
cd "$(dirname "$0")"

source ./test_common.sh

inspect() { docker inspect --format "$1" "${@:2}"; }
results() { find "$work/runs/$1" -name result.json | wc -l; }
sessions() { docker logs "$1" 2>&1 | grep -c 'a session ended' || true; }

# Waits for all learners, which must end with status 0.
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
environments = ["Hopper"]
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

# open_sessions CONTAINER: prints the number of a server's open sessions, which it reads from the server's metrics.
open_sessions() {
    docker exec "$1" bash -c 'exec 3<>/dev/tcp/127.0.0.1/9447; printf "GET /metrics HTTP/1.0\r\n\r\n" >&3; cat <&3' |
        sed -n 's/^perturb_sessions{} \([0-9]*\).*/\1/p'
}
# Pauses all learners and looks for a server with an open session. If it finds one, the learners stay paused, so that
# they cannot end the session before the script stops the server. Otherwise the learners continue, and the status is 1.
catch_session() {
    docker pause "${learners[@]}" >/dev/null || fail "the learners ended before a server could be stopped"
    for index in 0 1; do
        if [ "$(open_sessions "${servers[index]}")" -gt 0 ]; then
            stopped=${servers[index]} other=${servers[1 - index]}
            return 0
        fi
    done
    docker unpause "${learners[@]}" >/dev/null
    return 1
}
wait_for "a session" catch_session
left=$((cells - $(results broken)))
say "the learners are paused; open sessions: $(open_sessions "$stopped") on the server that is stopped, $(open_sessions "$other") on the other one"
docker stop "$stopped" >/dev/null
code=$(inspect '{{.State.ExitCode}}' "$stopped")
[ "$code" = 0 ] || fail "the stopped server ended with status $code"
docker unpause "${learners[@]}" >/dev/null
say "one server is stopped; $left of $cells cells were not done"

learners_end
lost=$(for learner in "${learners[@]}"; do docker logs "$learner" 2>&1; done | grep -c 'lost the server') || true
[ "$lost" -gt 0 ] || fail "no learner noticed that a server was stopped"
say "all learners have ended; they said $lost times that they lost the server, and went on with the other one"
say "sessions in all: $(sessions "$stopped") on the stopped server, $(sessions "$other") on the other one"
[ "$(inspect '{{.State.Health.Status}}' "$other")" = healthy ] || fail "the other server is no longer healthy"

cmp "$work/runs/whole.html" "$work/runs/broken.html" || fail "the reports differ"
diff -r "$work/runs/whole/report" "$work/runs/broken/report" || fail "the tables differ"
for result in "$work"/runs/whole/cells/*/result.json; do
    cmp "$result" "${result/whole/broken}" || fail "results differ"
done
say "the report, its tables and all results are the same bytes as without the stop"
compose down --timeout 2 >/dev/null 2>&1

cat >"$work/runs/plan.toml" <<'PLAN'
environments = ["ReachingArm", "Quadruped"]
versions = ["D", "R"]
test_episodes = 20
settings = { episodes = 40, num_envs = 4 }
[[algorithm]]
name = "ppo"
architectures = ["ff"]
PLAN
begun=$SECONDS
PERTURB_TASKS=$(realpath ../examples/tasks)
export PERTURB_NAME=tasks PERTURB_TASKS PERTURB_TASK_FOLDERS=/tasks/reaching_arm,/tasks/quadruped
files+=(--file tasks.yaml)
compose up --detach --no-build --scale server=2 --scale learner=2 >/dev/null 2>&1
say "two servers with two task folders, two learners"
learners_end
[ "$(results tasks)" = 4 ] || fail "$(results tasks) of 4 cells have a result"
hashes=$(grep -ho '"model_hash": *"[0-9a-f]*"' "$work"/runs/tasks/cells/*/result.json | sort -u | wc -l)
[ "$hashes" = 2 ] || fail "results of two tasks have $hashes model hashes"
say "all cells of both tasks are done"
echo "docker-test passed"
