"""Build loops.pyx once, into build/concealed/HASH, and import it: `from tests.concealed.compiled import loops`.

HASH is of the source, of the versions of Python, Cython and numpy, and of the processor's kind. It takes seconds, once.
"""

from __future__ import annotations

import hashlib
import importlib.machinery
import importlib.util
import os
import platform
import sys
import tempfile
from pathlib import Path
from types import ModuleType

import Cython
import numpy as np

SOURCE = Path(__file__).with_name("loops.pyx")
FOLDER = Path(__file__).parents[2] / "build/concealed"
# sums may be taken in any order; what runs away still becomes NaN
FLAGS = ["-O3", "-march=native", "-g0", "-fassociative-math", "-fno-signed-zeros", "-fno-trapping-math"]


def _processor() -> str:
    """The instructions that -march=native may use."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor()
    return next((line for line in lines if line.startswith(("flags", "Features"))), platform.machine())


def _built() -> Path:
    """The compiled module; made where it is not there yet."""
    words = (SOURCE.read_text(), sys.version, Cython.__version__, np.__version__, _processor(), *FLAGS)
    digest = hashlib.sha256("\n".join(words).encode()).hexdigest()[:16]
    name = f"loops{importlib.machinery.EXTENSION_SUFFIXES[0]}"
    target = FOLDER / digest / name
    if not target.exists():
        from Cython.Build import cythonize
        from setuptools import Distribution, Extension
        from setuptools.command.build_ext import build_ext

        FOLDER.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=FOLDER) as folder:
            part = Extension("loops", [str(SOURCE)], extra_compile_args=FLAGS)
            builder = build_ext(
                Distribution({"ext_modules": cythonize([part], build_dir=folder, quiet=True)})
            )
            builder.build_lib, builder.build_temp = folder, folder
            builder.ensure_finalized()
            builder.run()
            target.parent.mkdir(exist_ok=True)
            os.replace(Path(folder) / name, target)  # two processes may build at a time
    return target


def _imported() -> ModuleType:
    path = _built()
    spec = importlib.util.spec_from_file_location("loops", path)
    assert spec and spec.loader, path
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


loops = _imported()
