# Functions that test.sh and test_guarded.sh share: running Compose, a temporary folder, and cleaning up at the end.

if docker compose version >/dev/null 2>&1; then
    program=(docker compose)
elif command -v docker-compose >/dev/null; then
    program=(docker-compose)
else
    echo "neither \`docker compose\` nor docker-compose is there; install Docker Compose" >&2
    exit 1
fi
files=(--file compose.yaml)
compose() { "${program[@]}" "${files[@]}" --project-name "perturb-test-$$" "$@"; }

work=$(mktemp -d)
mkdir "$work/runs"
# Learners run as the caller of this script, but never as root.
user=$(id -u):$(id -g)
[ "$(id -u)" != 0 ] || { user=1000:1000; chown "$user" "$work/runs"; chmod 755 "$work"; }
export PERTURB_RUNS=$work/runs PERTURB_USER=$user PERTURB_PLAN=/runs/plan.toml PERTURB_LOG=info,perturb=debug
clean_up() {
    status=$?
    if [ $status != 0 ]; then
        compose logs --tail 40 || true
        tail -n 5 "$work"/runs/*/cells/*/log.txt || true
        echo "$0 FAILED" >&2
    fi
    compose down --timeout 2 >/dev/null 2>&1 || true
    rm -rf "$work"
    exit $status
}
trap clean_up EXIT

fail() { echo "FAILED: $*" >&2; exit 1; }
say() { printf '%4d s  %s\n' $((SECONDS - begun)) "$*"; }
# wait_for WHAT COMMAND…: waits until the command succeeds, for ten minutes at most.
wait_for() {
    local what=$1 deadline=$((SECONDS + 600))
    shift
    until "$@"; do
        [ $SECONDS -lt $deadline ] || fail "$what did not happen within ten minutes"
        sleep 0.2
    done
}
