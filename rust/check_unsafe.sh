#!/bin/bash
# Looks for what unsafe code can do wrong. From the repository's top:
#   bash rust/check_unsafe.sh [python]
#
# 1. Miri runs the tests of uninit.rs, where all unsafe code of the crates is, and one small rendering: borrows, races
#    between threads, reads of what was not set. It needs `rustup toolchain install nightly --component miri,rust-src`.
# 2. AddressSanitizer watches the tests of the crates, at each level of vectors of this CPU. The stable compiler can do
#    that, asked as its own makers ask it.
# 3. Valgrind watches calls through the binding from Python, for reads of what was not set or is freed. It has no
#    AVX-512, so that the level is AVX2. Python and mimalloc are told to let it see each allocation.
#
# What was done and how long it took comes last; what a tool that is not here would have done is told there, too.
set -euo pipefail
cd "$(dirname "$0")/.."
python=${1:-python}
export RAYON_NUM_THREADS=2
told=()

# The name of a part, the tool's trial and the function that does it.
part() {
    local start=$SECONDS
    echo "== $1"
    if $2 >/dev/null 2>&1; then
        $3
        told+=("$1: nothing found in $((SECONDS - start)) s")
    else
        told+=("$1: NOT DONE, '$2' does not run here")
    fi
}

# The threads of the pool outlive the tests; its queues turn numbers into pointers.
with_miri() {
    MIRIFLAGS='-Zmiri-ignore-leaks -Zmiri-tree-borrows -Zmiri-permissive-provenance' \
        cargo +nightly miri test -p hqgs --lib --target-dir target/miri -- uninit:: no_gaussians_and_none
}

# A test asks for more memory than there is, and wants an error.
with_sanitizer() {
    ASAN_OPTIONS=allocator_may_return_null=1 RUSTC_BOOTSTRAP=1 RUSTFLAGS=-Zsanitizer=address \
        cargo test -p hqgs -p hqgs-training --lib --target-dir target/asan \
        --target "$(rustc -vV | sed -n 's/^host: //p')"
}

with_valgrind() {
    CFLAGS=-DMI_TRACK_VALGRIND=1 cargo build -p hqgs-python --target-dir target/valgrind
    mkdir -p target/valgrind/module
    cp target/valgrind/debug/lib_rust.so target/valgrind/module/_rust.abi3.so
    HQGS_SIMD=avx2 PYTHONMALLOC=malloc PYTHONPATH=target/valgrind/module \
        valgrind --quiet --error-exitcode=9 --fair-sched=yes --suppressions=rust/valgrind.supp \
        "$python" rust/python/check_unsafe.py
}

part Miri 'cargo +nightly miri --version' with_miri
part AddressSanitizer 'cargo --version' with_sanitizer
part valgrind 'valgrind --version' with_valgrind
printf '%s\n' "${told[@]}"
