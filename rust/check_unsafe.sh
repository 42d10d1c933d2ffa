#!/bin/bash
# Looks for reads of uninitialised and of freed memory, and for accesses out of bounds, with valgrind: in the tests of
# the crate's unsafe code (uninit.rs) and of one small rendering, and in calls through the binding from Python.
# Takes some minutes. From the repository's top:  bash rust/check_unsafe.sh [python]
#
# Valgrind has no AVX-512, so that the level is AVX2. Python and mimalloc are told to let it see each allocation.
set -euo pipefail
cd "$(dirname "$0")/.."
python=${1:-python}
check=(valgrind --quiet --error-exitcode=9 --fair-sched=yes --suppressions=rust/valgrind.supp)

echo "== uninit.rs and one rendering"
tests=$(cargo test -p hqgs --lib --no-run --message-format=json |
    sed -n 's/.*"executable":"\([^"]*\)".*/\1/p' | tail -n 1)
HQGS_SIMD=avx2 RAYON_NUM_THREADS=2 "${check[@]}" "$tests" --test-threads=1 uninit:: no_gaussians_and

echo "== the binding"
CFLAGS=-DMI_TRACK_VALGRIND=1 cargo build -p hqgs-python --target-dir target/valgrind
mkdir -p target/valgrind/module
cp target/valgrind/debug/lib_rust.so target/valgrind/module/_rust.abi3.so
HQGS_SIMD=avx2 RAYON_NUM_THREADS=2 PYTHONMALLOC=malloc PYTHONPATH=target/valgrind/module \
    "${check[@]}" "$python" rust/python/check_unsafe.py
echo "nothing found"
