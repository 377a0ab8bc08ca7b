"""Libraries that could read a logger's CSV, in one run: installed size, import time, reading time and peak memory.

    python tests/bench/reading.py [--rows 200000]

The file has `;`, decimal comma, ISO times and 1 % empty cells. Every candidate ends with float64 columns and seconds. Each runs
in a process of its own; the smallest of three times counts. A candidate that is not installed is left out.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

HEAD = "import sys, time, json, resource\nstart = time.perf_counter()\n"
TAIL = """
print(json.dumps([loaded - start, min(times), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024, total]))
"""
BODY = """
loaded = time.perf_counter()
times = []
for _ in range(3):
    begin = time.perf_counter()
    total = read(sys.argv[1])
    times.append(time.perf_counter() - begin)
"""
CANDIDATES = {
    "pyarrow": """
import numpy as np, pyarrow as pa, pyarrow.csv, pyarrow.compute as pc
def read(path):
    names = open(path).readline().strip().split(";")
    table = pa.csv.read_csv(path, parse_options=pa.csv.ParseOptions(delimiter=";"), convert_options=pa.csv.ConvertOptions(
        decimal_point=",", column_types={n: pa.float64() for n in names[1:]} | {"Zeit": pa.timestamp("ns")}))
    t = table["Zeit"].to_numpy().astype("int64")
    return float((t - t[0])[-1] / 1e9 + sum(np.nansum(table[n].to_numpy()) for n in names[1:]))
""",
    "pandas": """
import numpy as np, pandas as pd
def read(path):
    table = pd.read_csv(path, sep=";", decimal=",", parse_dates=["Zeit"], date_format="ISO8601")
    t = table["Zeit"].to_numpy().astype("datetime64[ns]").astype("int64")
    return float((t - t[0])[-1] / 1e9 + sum(np.nansum(table[n].to_numpy()) for n in table.columns[1:]))
""",
    "polars": """
import numpy as np, polars as pl
def read(path):
    table = pl.read_csv(path, separator=";", decimal_comma=True, schema_overrides={"Zeit": pl.String})
    t = table["Zeit"].str.to_datetime(time_unit="ns").to_numpy().astype("int64")
    return float((t - t[0])[-1] / 1e9 + sum(np.nansum(table[n].to_numpy()) for n in table.columns[1:]))
""",
    "thermoctl": """
import numpy as np
from thermoctl.recording.foreign.logger import read_recording
def read(path):
    table = read_recording(path)
    return float(table.t[-1] + sum(np.nansum(c) for c in table.columns.values()))
""",
}
PACKAGES = {"pyarrow": ("pyarrow",), "pandas": ("pandas",), "polars": ("polars", "_polars_runtime_32")}


def write(path: Path, rows: int) -> None:
    rng = np.random.default_rng(1)
    columns = np.round(np.cumsum(rng.normal(size=(rows, 5)), axis=0) * 0.01 + 20, 4)
    begin = np.datetime64("2026-03-14T09:26:53.000", "ms")
    stamps = np.datetime_as_string(begin + np.arange(rows) * 1000 + rng.integers(0, 9, rows))
    lines = ["Zeit;P_heater;T_air;T_block;T_sink;x"]
    for stamp, row, missing in zip(stamps, columns, rng.random((rows, 5)) < 0.01, strict=True):
        cells = ("" if m else str(v).replace(".", ",") for v, m in zip(row, missing, strict=True))
        lines.append(";".join((stamp, *cells)))
    path.write_text("\n".join(lines) + "\n")


def size_mb(packages: tuple[str, ...]) -> float:
    found = (Path(p) / name for p in sys.path for name in packages)
    return sum(f.stat().st_size for d in found if d.is_dir() for f in d.rglob("*") if f.is_file()) / 1e6


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rows", type=int, default=200_000)
    rows = parser.parse_args().rows
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "run.csv"
        write(path, rows)
        print(
            f"{rows} rows, {path.stat().st_size / 1e6:.1f} MB, Python {sys.version.split()[0]}, {time.strftime('%F')}"
        )
        print(f"{'library':10} {'size MB':>8} {'import s':>9} {'read s':>8} {'peak MB':>8}  checksum")
        for name, code in CANDIDATES.items():
            run = subprocess.run(
                [sys.executable, "-c", HEAD + code + BODY + TAIL, str(path)], capture_output=True, text=True
            )
            if run.returncode:
                print(f"{name:10} {run.stderr.strip().splitlines()[-1]}")
                continue
            loaded, read, peak, total = json.loads(run.stdout)
            size = size_mb(PACKAGES[name]) if name in PACKAGES else 0.0
            print(f"{name:10} {size:8.0f} {loaded:9.2f} {read:8.3f} {peak:8.0f}  {total:.3f}")


if __name__ == "__main__":
    main()
