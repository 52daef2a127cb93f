"""The extension of compiled kernels; all else about the package is in pyproject.toml.

Without a compiler, or with ``QUASIHARMONIC_PURE=1``, the package is built without it and runs on NumPy alone.
"""

import os
import sys
import sysconfig
from pathlib import Path

from setuptools import Extension, setup

KERNELS = Path("src/quasiharmonic/util/kernels/c")
# A product and a sum rounded as one, where the processor can, would make results differ from machine to machine.
# The rest changes no result: nobody asks for errno or for the processor's flags, so choices need no jumps.
PRECISE = "-ffp-contract=off", "-fno-math-errno", "-fno-trapping-math"
FLAGS = ["/std:c11"] if sys.platform == "win32" else ["-std=c11", "-O3", "-fvisibility=hidden", *PRECISE]
# One wheel serves this Python and all later ones, but for those without the global lock.
STABLE = not sysconfig.get_config_var("Py_GIL_DISABLED")

if os.environ.get("QUASIHARMONIC_PURE", "0") not in ("", "0"):
    setup()
else:
    setup(
        ext_modules=[
            Extension(
                "quasiharmonic.util.kernels._compiled",
                sorted(str(path) for path in KERNELS.glob("*.c")),
                depends=sorted(str(path) for path in KERNELS.glob("*.h")),
                define_macros=[("Py_LIMITED_API", "0x030B0000")] if STABLE else [],
                py_limited_api=STABLE,
                extra_compile_args=FLAGS,
                libraries=[] if sys.platform == "win32" else ["m"],
                optional=True,
            )
        ],
        options={"bdist_wheel": {"py_limited_api": "cp311"}} if STABLE else {},
    )
