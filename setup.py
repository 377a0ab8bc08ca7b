"""Builds the compiled parts: every .pyx, and every .py with its C types in a .pxd. The rest is in pyproject.toml."""

import os
import re
import shutil
from itertools import groupby
from pathlib import Path

import numpy
from Cython.Build import cythonize
from setuptools import Extension, setup
from setuptools.command.build_ext import build_ext

HAL = Path("hal")  # `import hal` is LinuxCNC's: the folder holds the package thermoctl_hal
typed = [p for root in ("thermoctl", "hal") for p in Path(root).rglob("*.p[xy][xd]")]
PROCESSORS = len(os.sched_getaffinity(0))
sources = sorted(
    {p.with_suffix(".pyx") if p.with_suffix(".pyx").exists() else p.with_suffix(".py") for p in typed}
)


def module(source: Path) -> str:
    """Return the dotted name of a source file."""
    inside = source.relative_to(HAL) if HAL in source.parents else source
    return ".".join(inside.with_suffix("").parts)


class Build(build_ext):
    """Compiles what is newer than its copy in the clone; pip builds in an empty folder, where all would be new."""

    def initialize_options(self) -> None:
        """Compile a part on each processor."""
        super().initialize_options()
        self.parallel = PROCESSORS

    def build_extension(self, ext: Extension) -> None:
        """Compile one part, or take the clone's copy of it, whose time is kept."""
        there = Path(self.get_ext_fullpath(ext.name))
        here = Path(ext.sources[0]).with_name(there.name)
        if here.exists() and not there.exists():
            there.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(here, there)
        super().build_extension(ext)


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
if __name__ == "__main__":  # not in a process that translates a part
    setup(
        long_description=re.sub(r"!?\[([^\]]*)\]\((?!https?:)[^)]*\)", r"\1", README),
        long_description_content_type="text/markdown",
        data_files=shipped,
        cmdclass={"build_ext": Build},
        ext_modules=cythonize(
            [
                Extension(
                    module(p),
                    [str(p)],
                    depends=["setup.py"],
                    include_dirs=[numpy.get_include()],
                    extra_compile_args=["-O2", "-g0", "-ffp-contract=off"],
                    define_macros=[("NPY_NO_DEPRECATED_API", "NPY_1_7_API_VERSION")],
                )
                for p in sources
            ],
            compiler_directives={"language_level": "3"},
            include_path=[".", str(HAL)],
            nthreads=PROCESSORS,
        ),
    )
