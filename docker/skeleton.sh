#!/bin/sh
# skeleton.sh DIR: copies the Cargo manifests of the workspace in the current directory to DIR, with empty sources. DIR
# does not change when the real sources are edited, so Docker reuses the layer with the compiled dependencies. Compiling
# libtorch's bindings alone would take minutes.
set -eu
out=$1
mkdir -p "$out"
cp -R .cargo Cargo.lock "$out"
find . -name Cargo.toml | while read -r manifest; do
    package=$out/$(dirname "$manifest")
    mkdir -p "$package/src"
    # Remove the benchmarks, tests and examples from the manifest. Cargo would need their files, and images do not
    # contain them.
    sed -E '/^\[\[(bench|test|example)\]\]/,/^$/d' "$manifest" >"$package/Cargo.toml"
    echo '//! Empty.' >"$package/src/lib.rs"
    (cd "$(dirname "$manifest")" && find build.rs src/main.rs src/bin -name '*.rs' 2>/dev/null || true) | while read -r program; do
        mkdir -p "$(dirname "$package/$program")"
        printf '//! Empty.\n\nfn main() {}\n' >"$package/$program"
    done
done
