#!/usr/bin/env bash
# compare.sh PROGRAMS BUILD: builds the clients in C++ and Go in the folder BUILD. Plays every scenario on one server
# with these clients and with the Rust client, and compares the replies byte for byte. PROGRAMS contains perturb-server,
# and the Rust client as examples/client. Run the script from the repository's root. It needs the Debian packages that
# `make languages-test` installs.
set -euo pipefail

programs=$(realpath "$1")
mkdir -p "$2"
build=$(realpath "$2")
here=$PWD/examples/clients

mkdir -p "$build/cpp" "$build/go/src"
protoc -I proto --cpp_out="$build/cpp" --grpc_out="$build/cpp" \
    --plugin=protoc-gen-grpc="$(command -v grpc_cpp_plugin)" perturb/v1/perturb.proto
g++ -std=c++17 -O1 -I "$build/cpp" -o "$build/client-cpp" \
    "$here/client.cc" "$build"/cpp/perturb/v1/perturb.{pb,grpc.pb}.cc $(pkg-config --cflags --libs grpc++ protobuf)

# Debian's Go packages are in a GOPATH, so nothing is downloaded.
protoc -I proto --go_out="$build/go/src" --go-grpc_out="$build/go/src" perturb/v1/perturb.proto
GO111MODULE=off GOFLAGS=-mod= GOPATH=$build/go:/usr/share/gocode GOCACHE=$build/go-cache \
    go build -o "$build/client-go" "$here/client.go"

"$programs/perturb-server" --listen "unix:$build/server.sock" --log warn >"$build/server.log" &
server=$!
trap 'kill "$server"' EXIT
for _ in $(seq 100); do
    [ -S "$build/server.sock" ] && break
    sleep 0.1
done

failed=0
for scenario in cart_pole hopper snapshots act; do
    for client in "$programs/examples/client" "$build/client-cpp" "$build/client-go"; do
        name=$(basename "$client")
        replies=$build/$scenario.$name
        rm -f "$replies"
        "$client" "unix:$build/server.sock" "$scenario" "$replies"
        printf '%-10s %-11s %9d bytes  sha256 %s\n' "$scenario" "$name" "$(stat --format=%s "$replies")" \
            "$(sha256sum <"$replies" | cut -d ' ' -f 1)"
        cmp "$build/$scenario.client" "$replies" || failed=1
    done
done
[ "$failed" = 0 ] || { echo "languages-test failed: replies differ" >&2; exit 1; }
echo "languages-test passed: the clients in Rust, C++ and Go got the same replies"
