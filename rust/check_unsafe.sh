#!/bin/bash
# Looks for what unsafe code can do wrong, in some minutes. From the repository's top:
#   bash rust/check_unsafe.sh [python]
#
# 1. Miri runs the tests of uninit.rs, where all unsafe code of the crates is, and one small rendering: borrows, races
#    between threads, reads of what was not set.
# 2. AddressSanitizer watches all tests of the crates, at each level of vectors of this CPU.
# 3. Valgrind watches calls through the binding from Python, for reads of what was not set or is freed. It has no
#    AVX-512, so that the level is AVX2. Python and mimalloc are told to let it see each allocation.
#
# The first two need `rustup toolchain install nightly --component miri,rust-src`.
set -euo pipefail
cd "$(dirname "$0")/.."
python=${1:-python}
export RAYON_NUM_THREADS=2

echo "== Miri"
# The threads of the pool outlive the tests; its queues turn numbers into pointers.
MIRIFLAGS='-Zmiri-ignore-leaks -Zmiri-tree-borrows -Zmiri-permissive-provenance' \
    cargo +nightly miri test -p hqgs --lib --target-dir target/miri -- uninit:: no_gaussians_and_none

echo "== AddressSanitizer"
RUSTFLAGS=-Zsanitizer=address cargo +nightly test -p hqgs -p hqgs-training --lib --tests \
    --target "$(rustc -vV | sed -n 's/^host: //p')" --target-dir target/asan

echo "== valgrind, the binding"
CFLAGS=-DMI_TRACK_VALGRIND=1 cargo build -p hqgs-python --target-dir target/valgrind
mkdir -p target/valgrind/module
cp target/valgrind/debug/lib_rust.so target/valgrind/module/_rust.abi3.so
HQGS_SIMD=avx2 PYTHONMALLOC=malloc PYTHONPATH=target/valgrind/module \
    valgrind --quiet --error-exitcode=9 --fair-sched=yes --suppressions=rust/valgrind.supp \
    "$python" rust/python/check_unsafe.py
echo "nothing found"
