#!/bin/sh
# skeleton.sh DIR: copies the manifests of the workspace in the current directory to DIR, with empty programs. The result
# stays the same when sources are edited. So the image's layer of compiled dependencies stays, too; libtorch's bindings
# alone take minutes.
set -eu
out=$1
mkdir -p "$out"
cp -R .cargo Cargo.lock "$out"
find . -name Cargo.toml | while read -r manifest; do
    package=$out/$(dirname "$manifest")
    mkdir -p "$package/src"
    # Named targets need their files, and none of them is part of an image.
    sed -E '/^\[\[(bench|test|example)\]\]/,/^$/d' "$manifest" >"$package/Cargo.toml"
    echo '//! Empty.' >"$package/src/lib.rs"
    (cd "$(dirname "$manifest")" && find build.rs src/main.rs src/bin -name '*.rs' 2>/dev/null || true) | while read -r program; do
        mkdir -p "$(dirname "$package/$program")"
        printf '//! Empty.\n\nfn main() {}\n' >"$package/$program"
    done
done
