#!/bin/sh
# skeleton.sh DIR: makes in DIR what decides how the dependencies are built: the manifests of the workspace in the
# current directory, around empty programs. It stays the same when sources are edited, and with it the image's layer of
# compiled dependencies, of which libtorch's bindings take minutes.
set -eu
out=$1
mkdir -p "$out"
cp -R .cargo Cargo.lock "$out"
find . -name Cargo.toml | while read -r manifest; do
    package=$out/$(dirname "$manifest")
    mkdir -p "$package/src"
    # Targets that are named need their files; none is part of an image.
    sed -E '/^\[\[(bench|test|example)\]\]/,/^$/d' "$manifest" >"$package/Cargo.toml"
    echo '//! Empty.' >"$package/src/lib.rs"
    (cd "$(dirname "$manifest")" && find build.rs src/main.rs src/bin -name '*.rs' 2>/dev/null || true) | while read -r program; do
        mkdir -p "$(dirname "$package/$program")"
        printf '//! Empty.\n\nfn main() {}\n' >"$package/$program"
    done
done
