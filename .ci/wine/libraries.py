"""Write the sources of two libraries: python3.dll, and ucrtbase.dll with the complex functions that Wine 8 lacks.

    python libraries.py PYTHON311_DLL WINE_UCRTBASE_DLL

writes python3.def, ucrtbase.def and ucrtbase.c into the current folder. Both libraries pass all other functions on, to
python311.dll and to a copy of Wine's ucrtbase.dll named ucrtwine.dll.
"""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

OBJDUMP = "x86_64-w64-mingw32-objdump"
ONE_ARGUMENT = [
    "acos",
    "acosh",
    "asin",
    "asinh",
    "atan",
    "atanh",
    "cos",
    "cosh",
    "exp",
    "log",
    "proj",
    "sin",
    "sinh",
    "sqrt",
    "tan",
    "tanh",
]

# Windows passes and returns complex numbers as it does structures.
HEAD = """#include <complex.h>
#include <math.h>

typedef struct { float re, im; } Single;
typedef struct { double re, im; } Double;

static double complex from_single(Single z) { return z.re + I * z.im; }
static double complex from_double(Double z) { return z.re + I * z.im; }
static Single to_single(double complex z) { return (Single){(float)creal(z), (float)cimag(z)}; }
static Double to_double(double complex z) { return (Double){creal(z), cimag(z)}; }
"""


def exported(library: str) -> list[str]:
    """Return the names of a library's functions."""
    text = subprocess.run([OBJDUMP, "-p", library], capture_output=True, text=True, check=True).stdout
    table = text[text.index("[Ordinal/Name Pointer] Table") :]
    return re.findall(r"\[\s*\d+\]\s+(?:\+base\[\s*\d+\]\s+\w+\s+)?(\S+)", table)


def complex_functions() -> tuple[str, list[str]]:
    """Return C source of the complex functions, and their names; in the source each has the prefix `own_`."""
    lines, names = [HEAD], []
    for suffix, kind, real, of in (
        ("", "Double", "double", "double"),
        ("l", "Double", "double", "double"),
        ("f", "Single", "float", "single"),
    ):
        for name in ONE_ARGUMENT:
            lines.append(f"{kind} own_c{name}{suffix}({kind} z) {{ return to_{of}(c{name}(from_{of}(z))); }}")
        lines.append(
            f"{kind} own_cpow{suffix}({kind} z, {kind} w) {{ return to_{of}(cpow(from_{of}(z), from_{of}(w))); }}"
        )
        lines.append(f"{kind} own_conj{suffix}({kind} z) {{ return ({kind}){{z.re, -z.im}}; }}")
        for name, value in (
            ("creal", "z.re"),
            ("cimag", "z.im"),
            ("carg", "atan2(z.im, z.re)"),
            ("cabs", "hypot(z.re, z.im)"),
        ):
            lines.append(f"{real} own_{name}{suffix}({kind} z) {{ return ({real}){value}; }}")
        names += [f"c{name}{suffix}" for name in (*ONE_ARGUMENT, "pow", "real", "imag", "arg", "abs")]
        names.append(f"conj{suffix}")
    return "\n".join(lines) + "\n", names


def definition(library: str, own: list[str], passed_on: list[str], to: str) -> str:
    """Return a linker's definition file."""
    rows = [f"{name}=own_{name}" for name in own] + [f"{name}={to}.{name}" for name in passed_on if name not in own]
    return "\n".join([f"LIBRARY {library}", "EXPORTS", *rows, ""])


if __name__ == "__main__":
    python, ucrt = sys.argv[1:]
    source, names = complex_functions()
    Path("ucrtbase.c").write_text(source, encoding="utf-8")
    Path("ucrtbase.def").write_text(definition("ucrtbase", names, exported(ucrt), "ucrtwine"), encoding="utf-8")
    Path("python3.def").write_text(definition("python3", [], exported(python), "python311"), encoding="utf-8")
