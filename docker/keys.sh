#!/usr/bin/env bash
# keys.sh DIR: makes the keys for guarded.yaml in DIR. They are a certificate authority, certificates for servers
# (DIR/server) and learners (DIR/learner) that are valid for a year, and a token with its entry in tokens.toml. Only the
# caller can enter DIR. The files in it are readable for everybody, because containers run as other users. To make new
# keys, remove DIR.
set -euo pipefail
[ $# = 1 ] || { echo "expected a folder: keys.sh DIR" >&2; exit 2; }
[ ! -e "$1" ] || { echo "$1 is there already; remove it to have other keys" >&2; exit 1; }
umask 022
mkdir -m 700 "$1"
cd "$1"
mkdir server learner authority
quietly() { "$@" 2>authority/log || { cat authority/log >&2; exit 1; }; }

key=(-newkey ec -pkeyopt ec_paramgen_curve:P-256 -nodes)
quietly openssl req -x509 "${key[@]}" -days 3650 -subj "/CN=perturb authority" -keyout authority/ca.key -out authority/ca.pem
# signed OUT NAME [EXTENSION]: makes a certificate for NAME, signed by the authority, in OUT.pem and its key in OUT.key.
signed() {
    quietly openssl req "${key[@]}" -subj "/CN=$2" -keyout "$1.key" -out authority/csr
    quietly openssl x509 -req -in authority/csr -CA authority/ca.pem -CAkey authority/ca.key -CAcreateserial -days 365 \
        -out "$1.pem" -extfile <(printf "basicConstraints = CA:FALSE\n%s\n" "${3-}")
}
# Learners connect to the name `server`. The server's health check connects to localhost or 127.0.0.1.
signed server/server server "subjectAltName = DNS:server, DNS:localhost, IP:127.0.0.1"
signed learner/learner learner
cp authority/ca.pem server/clients.pem
cp authority/ca.pem learner/ca.pem
token=$(openssl rand -hex 32)
echo "$token" >learner/token
cat >server/tokens.toml <<TOKENS
[[token]]
name = "learner"
sha256 = "$(printf %s "$token" | sha256sum | cut -d ' ' -f 1)"

# docs/access.md#tokens describes quotas and roles.
TOKENS
chmod 644 server/* learner/*
echo "made $PWD: server for servers, learner for learners, authority for nobody"
