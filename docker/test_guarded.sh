#!/usr/bin/env bash
# Runs a small experiment with compose.yaml and guarded.yaml, i.e. with servers that use TLS and require certificates
# and tokens from learners. Then checks that learners with a wrong or expired certificate, a wrong token or a wrong role
# are refused with a clear message. Needs the two images, which `make docker` builds.
set -euo pipefail
cd "$(dirname "$0")"

source ./test_common.sh

files+=(--file guarded.yaml)
keys=$work/keys
export PERTURB_KEYS=$keys PERTURB_ADDRESS=https://server:7447 PERTURB_NAME=guarded
begun=$SECONDS

./keys.sh "$keys" >/dev/null
chmod 755 "$keys" # Docker's daemon may run as another user
./keys.sh "$work/others" >/dev/null
cp "$work/others/learner/learner.pem" "$keys/learner/stranger.pem"
cp "$work/others/learner/learner.key" "$keys/learner/stranger.key"
cp "$work/others/learner/ca.pem" "$keys/learner/stranger_ca.pem"
cp "$keys/learner/learner.key" "$keys/learner/expired.key"
openssl req -new -key "$keys/learner/expired.key" -subj "/CN=learner" -out "$work/csr" 2>/dev/null
openssl x509 -req -in "$work/csr" -CA "$keys/authority/ca.pem" -CAkey "$keys/authority/ca.key" -days -1 \
    -extfile <(echo "basicConstraints = CA:FALSE") -out "$keys/learner/expired.pem" 2>/dev/null
echo "another-horse-battery" >"$keys/learner/another"
sed -i 's/^sha256 = .*/&\nrole = "train"/' "$keys/server/tokens.toml"
cat >>"$keys/server/tokens.toml" <<'TOKENS'
[[role]]
name = "train"
draws = ["D", "R"]
TOKENS
chmod 644 "$keys"/*/*

cat >"$work/runs/plan.toml" <<'PLAN'
environments = ["CartPole"]
versions = ["D", "R"]
test_versions = ["D", "R"]
test_episodes = 20
settings = { episodes = 60 }
[[algorithm]]
name = "a2c"
architectures = ["ff"]
PLAN

compose up --detach --no-build --scale server=2 --scale learner=2 >/dev/null 2>&1
codes=$(compose ps --quiet learner | xargs docker wait)
[ "$(sort -u <<<"$codes")" = 0 ] || fail "the learners ended with status ${codes//$'\n'/, }"
[ "$(find "$work/runs/guarded" -name result.json | wc -l)" = 2 ] || fail "not both cells have a result"
say "two servers and two learners with certificates and tokens: the report is there"

# refused SENTENCE VERSION [VARIABLE=VALUE…]: runs a learner that trains on VERSION, with these environment variables.
# The learner must fail, and its output must contain SENTENCE.
refused() {
    local sentence=$1 version=$2 status=0 words arguments=()
    shift 2
    for variable in "$@"; do arguments+=(-e "$variable"); done
    words=$(compose run --rm --no-deps "${arguments[@]}" learner train --server https://server:7447 --env CartPole \
        --version "$version" --algorithm a2c --episodes 20 --out "/runs/refused-$RANDOM" 2>&1 </dev/null) || status=$?
    [ $status != 0 ] || fail "$* $version ended well: $words"
    grep -qF "$sentence" <<<"$words" || fail "$* $version was not told \"$sentence\" but: $words"
    say "$version ${*:-as it is}: $sentence"
}
refused "it accepts no client with the certificate" R PERTURB_CERT=/keys/stranger.pem PERTURB_KEY=/keys/stranger.key
refused "the certificate of PERTURB_CERT has expired" R PERTURB_CERT=/keys/expired.pem PERTURB_KEY=/keys/expired.key
refused "asks for a client's certificate" R PERTURB_CERT= PERTURB_KEY=
refused "no trusted authority" R PERTURB_CA=/keys/stranger_ca.pem
refused "does not know the token" R PERTURB_TOKEN_FILE=/keys/another
refused "requires a token" R PERTURB_TOKEN_FILE=
refused 'a token of the role "train" may not draw from' E

for server in $(compose ps --quiet server); do
    health=$(docker inspect --format '{{.State.Health.Status}}' "$server")
    [ "$health" = healthy ] || fail "a server is $health"
done
say "both servers are healthy"
echo "docker-test of guarded servers passed"
