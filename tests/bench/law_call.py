"""Which compiler for the law: one call from Python, start-up, and life under MemoryDenyWriteExecute.

    python tests/bench/law_call.py

The same work in each: predict 12 states, correct with one reading (34)-(35), twelve temperatures, one PID step (41).
`law` is the product's own Law.step, which also judges 20 readings, checks every limit and runs the arming machine.
Each candidate runs in a process of its own: start-up is import and first call, without and with what it caches; the last
column is the same start with memory that is never both writable and executable (prctl PR_SET_MDWE, Linux 6.3; what
systemd's MemoryDenyWriteExecute asks for).
"""

from __future__ import annotations

import ctypes
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
N, CALLS = 12, 2000
PR_SET_MDWE, PR_MDWE_REFUSE_EXEC_GAIN = 65, 1

C_SOURCE = """
static double clip(double v, double lo, double hi) { return v < lo ? lo : v > hi ? hi : v; }
void law_step(const double *A, const double *B, const double *zeta, double *x, double *s, double power, double y,
          double position, double reference) {
    double dx[12];
    for (int i = 0; i < 12; i++) {
        double a = B[i] * power;
        for (int j = 0; j < 12; j++) a += A[12 * i + j] * x[j];
        dx[i] = a;
    }
    for (int i = 0; i < 12; i++) x[i] += dx[i];
    double prior = s[0] * 0.9999 + 1e-4, k = prior / (prior + 0.04), e = y - x[0];
    s[0] = prior * (1.0 - k);
    for (int i = 0; i < 12; i++) x[i] += k * zeta[i] * e;
    double eps = reference - position - x[1], change = eps - s[2], d = change / 1e-3;
    s[1] = clip(s[1] + 0.01 * (change + 0.25 * eps + 0.001 * (d - s[3])), -2.0, 2.0);
    s[2] = eps; s[3] = d;
}
"""

PYX_SOURCE = """
# cython: language_level=3, boundscheck=False, wraparound=False, cdivision=True
cdef extern from *:
    '''@SOURCE@'''
    void law_step(const double *A, const double *B, const double *z, double *x, double *s, double p, double y,
                       double q, double r) noexcept nogil
cdef class Law:
    cdef double[::1] A, B, z, x, s
    def __init__(self, A, B, z, x, s):
        self.A, self.B, self.z, self.x, self.s = A, B, z, x, s
    cpdef step(self, double power, double y, double position, double reference):
        law_step(&self.A[0], &self.B[0], &self.z[0], &self.x[0], &self.s[0], power, y, position, reference)
""".replace("@SOURCE@", C_SOURCE)


def arrays():
    import numpy as np

    rng = np.random.default_rng(1)
    A = -np.eye(N) * 1e-5 + rng.normal(size=(N, N)) * 1e-7
    return (
        np.ascontiguousarray(A),
        np.full(N, 1e-6),
        np.linspace(1, 0.1, N),
        np.zeros(N),
        np.array([1.0, 0.0, 0.0, 0.0]),
    )


def make_law(work):
    sys.path.insert(0, str(ROOT))
    import numpy as np

    from thermoctl.control.law import Law
    from thermoctl.control.model import CompensatorModel, Parameters

    A, B, zeta, _, _ = arrays()
    model = CompensatorModel(
        "mkf",
        1e-3,
        A,
        np.column_stack([B, B]),
        np.eye(N),
        zeta,
        1e-4,
        0.04,
        0.9,
        np.ones(12),
        np.ones(12),
        1.0,
    )
    law = Law(model, Parameters(kp=0.01, ti_s=0.004, td_s=0.001, output_limit=2.0), 1e-3)
    law.bind(np.full(20, 22.0), np.ones(20, np.uint8), np.zeros(20, np.uint8))
    return lambda k: law.step(1e-3)


def make_cython(work):
    sys.path.insert(0, str(work))
    from bench_law import Law

    step = Law(*(a.ravel() for a in arrays())).step
    return lambda k: step(1.0, 0.1, 1.0, 2.0)


def make_cffi(work):
    import cffi

    ffi = cffi.FFI()
    ffi.cdef(
        "void law_step(const double*, const double*, const double*, double*, double*, double, double, double, double);"
    )
    library = ffi.dlopen(str(work / "step.so"))
    kept = arrays()
    A, B, z, x, s = (ffi.cast("double *", a.ctypes.data) for a in kept)
    return lambda k, kept=kept: library.law_step(A, B, z, x, s, 1.0, 0.1, 1.0, 2.0)


def make_ctypes(work):
    step = ctypes.CDLL(str(work / "step.so")).law_step
    step.argtypes = [ctypes.c_void_p] * 5 + [ctypes.c_double] * 4
    kept = arrays()
    pointers = [a.ctypes.data for a in kept]
    return lambda k, kept=kept: step(*pointers, 1.0, 0.1, 1.0, 2.0)


def make_numba(work):
    import numba

    @numba.njit(cache=True)
    def step(A, B, z, x, s, power, y, position, reference):
        dx = np_dot(A, x)
        for i in range(N):
            x[i] += dx[i] + B[i] * power
        prior = s[0] * 0.9999 + 1e-4
        k = prior / (prior + 0.04)
        e = y - x[0]
        s[0] = prior * (1.0 - k)
        for i in range(N):
            x[i] += k * z[i] * e
        eps = reference - position - x[1]
        change = eps - s[2]
        d = change / 1e-3
        s[1] = min(max(s[1] + 0.01 * (change + 0.25 * eps + 0.001 * (d - s[3])), -2.0), 2.0)
        s[2], s[3] = eps, d

    @numba.njit(cache=True)
    def np_dot(A, x):
        out = x.copy()
        for i in range(N):
            a = 0.0
            for j in range(N):
                a += A[i, j] * x[j]
            out[i] = a
        return out

    given = arrays()
    return lambda k: step(*given, 1.0, 0.1, 1.0, 2.0)


def make_numpy(work):
    import numpy as np

    A, B, z, x, s = arrays()

    def step(k):
        nonlocal x
        x = x + A @ x + B * 1.0
        prior = s[0] * 0.9999 + 1e-4
        gain = prior / (prior + 0.04)
        s[0] = prior * (1.0 - gain)
        x = x + gain * (0.1 - x[0]) * z
        eps = 2.0 - 1.0 - x[1]
        change = eps - s[2]
        d = change / 1e-3
        s[1] = np.clip(s[1] + 0.01 * (change + 0.25 * eps + 0.001 * (d - s[3])), -2.0, 2.0)
        s[2], s[3] = eps, d

    return step


CANDIDATES = {
    "cython": make_cython,
    "cffi": make_cffi,
    "ctypes": make_ctypes,
    "numba": make_numba,
    "numpy": make_numpy,
    "law (Cython, whole)": make_law,
}


def child(name: str, work: Path, deny: bool) -> None:
    """Start one candidate, time its calls, print JSON."""
    if deny and ctypes.CDLL(None).prctl(PR_SET_MDWE, PR_MDWE_REFUSE_EXEC_GAIN, 0, 0, 0) != 0:
        print(json.dumps({"unsupported": True}))
        return
    import numpy as np

    begin = time.perf_counter()
    call = CANDIDATES[name](work)
    call(0)
    start_s = time.perf_counter() - begin
    best = []
    for _ in range(30):
        t = time.perf_counter_ns()
        for k in range(CALLS // 10):
            call(k)
        best.append((time.perf_counter_ns() - t) / (CALLS // 10))
    print(json.dumps({"start_s": start_s, "median_ns": float(np.median(best)), "least_ns": min(best)}))


def run(name: str, work: Path, cache: Path, deny: bool = False) -> dict:
    environment = {
        **os.environ,
        "NUMBA_CACHE_DIR": str(cache),
        "OPENBLAS_NUM_THREADS": "1",
        "PYTHONPATH": str(ROOT),
    }
    done = subprocess.run(
        [sys.executable, __file__, "--child", name, str(work), str(int(deny))],
        capture_output=True,
        text=True,
        env=environment,
    )
    if done.returncode:
        return {"failed": (done.stderr.strip().splitlines() or [f"signal {-done.returncode}"])[-1][:60]}
    return json.loads(done.stdout)


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        work, cache = Path(folder), Path(folder) / "cache"
        (work / "step.c").write_text(C_SOURCE)
        flags = ["-O2", "-ffp-contract=off", "-shared", "-fPIC"]
        subprocess.run(["cc", *flags, "-o", str(work / "step.so"), str(work / "step.c")], check=True)
        (work / "bench_law.pyx").write_text(PYX_SOURCE)
        subprocess.run(
            [sys.executable, "-m", "Cython.Build.Cythonize", "-i", "-q", str(work / "bench_law.pyx")],
            check=True,
            cwd=work,
        )
        print(
            f"{'candidate':22}{'a call':>10}{'over ctypes':>13}{'first start':>13}{'again':>9}   under MDWE"
        )
        reference = None
        for name in ("ctypes", *(n for n in CANDIDATES if n != "ctypes")):
            first, again, denied = (
                run(name, work, cache),
                run(name, work, cache),
                run(name, work, cache / "denied", True),
            )
            if "failed" in first:
                print(f"{name:22}  not here: {first['failed']}")
                continue
            reference = reference or again["median_ns"]
            life = (
                "fails: " + denied["failed"]
                if "failed" in denied
                else ("kernel has no PR_SET_MDWE" if "unsupported" in denied else "runs")
            )
            print(
                f"{name:22}{again['median_ns']:7.0f} ns{again['median_ns'] / reference:12.2f}x{first['start_s']:11.3f} s"
                f"{again['start_s']:7.3f} s   {life}"
            )


if __name__ == "__main__":
    if sys.argv[1:2] == ["--child"]:
        child(sys.argv[2], Path(sys.argv[3]), sys.argv[4] == "1")
    else:
        main()
