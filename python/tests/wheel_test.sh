#!/bin/sh
# wheel_test.sh WHEEL DEPENDENCIES: installs the wheel in a new environment, with dependencies only from the folder
# DEPENDENCIES, and runs its programs, the loop in the README, and robots. With BARE=1 it checks that there is no compiler.
set -eu
wheel=$1 dependencies=$2
here=$(cd "$(dirname "$0")" && pwd)
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
for tool in cc gcc clang cargo rustc; do
    if [ -n "${BARE:-}" ] && command -v "$tool" >/dev/null; then
        echo "$tool is installed; with BARE=1 the wheel is tested without a compiler" >&2
        exit 1
    fi
done
case $wheel in
*-manylinux_2_34_x86_64.whl) ;;
*)
    echo "$wheel needs another glibc than 2.34, which is promised" >&2
    exit 1
    ;;
esac
unset PERTURB_SERVER

seconds() { # runs a command without its output, and prints how long it took in seconds
    start=$(date +%s.%N)
    "$@" >"$work/output" 2>&1 || { cat "$work/output" >&2; exit 1; }
    echo "$(date +%s.%N) $start" | awk '{ printf "%.1f s\n", $1 - $2 }'
}

python3 --version
ldd --version | head -1
python3 -m venv "$work/venv"
python=$work/venv/bin/python
took=$(seconds "$work/venv/bin/pip" install -q --disable-pip-version-check --no-index --find-links "$dependencies" "$wheel")
echo "install: $took"
"$work/venv/bin/pip" check
files=$(echo "$work"/venv/lib/python3*/site-packages/perturb*)
# shellcheck disable=SC2086  # the variable has several names without spaces
echo "wheel: $(du -k "$wheel" | cut -f1) kB; installed: $(du -kc $files | tail -1 | cut -f1) kB"

took=$(seconds "$work/venv/bin/perturb-server" --help)
echo "perturb-server --help: $took"
grep -q -- --listen "$work/output"
"$work/venv/bin/perturb-server" --version
"$work/venv/bin/perturb" --version
cd "$work"
took=$(seconds "$work/venv/bin/perturb" --quiet train --env CartPole --algorithm a2c --episodes 200 --out run)
echo "perturb train, 200 episodes: $took"
took=$(seconds "$work/venv/bin/perturb" --quiet evaluate --checkpoint run --episodes 20)
echo "perturb evaluate, 20 episodes: $took"
cat "$work/output"
if "$work/venv/bin/perturb" train --env CartPole --architecture rc --out recurrent 2>"$work/output"; then
    echo "a recurrent policy was trained without libtorch" >&2
    exit 1
fi
grep "make recurrent" "$work/output"
took=$(seconds "$python" "$here/../examples/ten_lines.py")
echo "README's loop, eight Hoppers: $took"
grep -q "ended:" "$work/output"
"$python" - <<'END'
import numpy as np
import perturb

envs = perturb.PerturbVectorEnv("HalfCheetah", 4, render_mode="rgb_array")
envs.reset(seed=1)
assert envs.step(np.zeros((4, 6), dtype=np.float32))[0].shape == (4, 26)
try:
    print("picture:", envs.render()[0].shape)
except perturb.RenderError as error:
    print("without OpenGL:", error)
envs.close()
END
echo "the wheel needs nothing else"
