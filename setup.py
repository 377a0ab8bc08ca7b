"""Builds the compiled parts: every .pyx, and every .py with its C types in a .pxd. The rest is in pyproject.toml."""

import re
from itertools import groupby
from pathlib import Path

import numpy
from Cython.Build import cythonize
from setuptools import Extension, setup

HAL = Path("hal")  # `import hal` is LinuxCNC's: the folder holds the package thermoctl_hal
typed = [p for root in ("thermoctl", "hal") for p in Path(root).rglob("*.p[xy][xd]")]
sources = sorted(
    {p.with_suffix(".pyx") if p.with_suffix(".pyx").exists() else p.with_suffix(".py") for p in typed}
)


def module(source: Path) -> str:
    """Return the dotted name of a source file."""
    inside = source.relative_to(HAL) if HAL in source.parents else source
    return ".".join(inside.with_suffix("").parts)


# Beside the package, under share/thermoctl: thermoctl/files/shipped.py finds them.
files = sorted(
    p for root in ("config", "docs/examples", "systemd") for p in Path(root).rglob("*.*") if p.is_file()
)
shipped = [
    (f"share/thermoctl/{folder}", list(map(str, of))) for folder, of in groupby(files, lambda p: p.parent)
]

# An index has no files beside README: its links and pictures become their words.
README = Path("README.md").read_text(encoding="utf-8")

# -g0: no debug symbols, which were 15 of the compiled parts' 19 MB.
# -ffp-contract=off: the law gives the same bits on every machine that a recording is replayed on.
setup(
    long_description=re.sub(r"!?\[([^\]]*)\]\((?!https?:)[^)]*\)", r"\1", README),
    long_description_content_type="text/markdown",
    data_files=shipped,
    ext_modules=cythonize(
        [
            Extension(
                module(p),
                [str(p)],
                include_dirs=[numpy.get_include()],
                extra_compile_args=["-O2", "-g0", "-ffp-contract=off"],
                define_macros=[("NPY_NO_DEPRECATED_API", "NPY_1_7_API_VERSION")],
            )
            for p in sources
        ],
        compiler_directives={"language_level": "3"},
        include_path=[".", str(HAL)],
    ),
)
