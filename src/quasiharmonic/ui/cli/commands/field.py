"""``qhm field``: compute the nearest displacement field of an image without folds, and its inverse."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from quasiharmonic.ui.cli.arguments import Commands


def add_parser(commands: Commands) -> None:
    """Declare the command."""
    from quasiharmonic.ui.cli import arguments

    parser = commands.add_parser(
        "field",
        description="Make a displacement field invertible with the least change. Away from folds "
        "the field is unchanged, bit for bit. It is an array .npy of shape (height, width, 2), displacements "
        "along x, to the right, and y, down, in the unit of --spacing.",
        epilog="Exit status: 0 the written field is certified without folds; 1 written, but the inverse that "
        "--inverse requests does not exist, because the border overlaps itself; 2 wrong input or call, or no such "
        "field was found, nothing written; 3 written, but the report failed.",
        examples=(
            "qhm field field.npy -o field_without_folds.npy",
            "qhm field field.npy --inverse inverse.npy -o field_without_folds.npy",
        ),
    )
    parser.add_argument("input", type=Path, metavar="INPUT", help=".npy file")
    parser.add_argument("-o", "--output", type=Path, required=True, help=".npy file to write")
    parser.add_argument(
        "--inverse",
        type=Path,
        metavar="FILE",
        help="also write the inverse of the new field, on the same grid, as .npy; NaN outside the field's image",
    )
    parser.add_argument(
        "--spacing",
        type=float,
        nargs="+",
        default=[1.0],
        metavar="LENGTH",
        help="distance between pixels; or two, along x and along y (default: 1)",
    )
    parser.add_argument(
        "--min-jacobian",
        type=float,
        default=0.01,
        metavar="DET",
        help="lower bound of all Jacobian determinants (default: 0.01)",
    )
    parser.add_argument("--fix-border", action="store_true", help="keep the displacements of the border's pixels")
    arguments.add_report(parser)
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Read, make invertible, write, report."""
    from quasiharmonic.apps.displacement_fields.nearest import nearest_invertible
    from quasiharmonic.ui.cli import report

    outputs = {"-o": options.output, **({} if options.inverse is None else {"--inverse": options.inverse})}
    for what, path in outputs.items():
        if path.suffix.lower() != ".npy":
            raise ValueError(f"{what} {path}: fields are written as .npy")
    report.check_new(outputs, options.json, inputs=(options.input,))
    spacing = options.spacing if len(options.spacing) > 1 else options.spacing[0]
    field = _read(options.input)
    with report.about(options.input):
        held = _border(field) if options.fix_border else None
        try:
            repaired = nearest_invertible(field, spacing=spacing, min_jacobian=options.min_jacobian, fixed=held)
        except RuntimeError as error:
            raise ValueError(str(error)) from error
    _write(options.output, repaired.field)
    invertible = bool(repaired.certificate.bijective)
    with report.after_writing(options.output):
        facts: dict[str, Any] = {
            "injective": repaired.certificate.injective,
            "bijective": invertible,
            "folds": repaired.folds,
            "moved": int(repaired.moved_mask.sum()),
            "patches": repaired.patches,
            "distance": repaired.distance,
            "seconds": repaired.seconds,
            "input": str(options.input),
            "output": str(options.output),
        }
        lines = [f"wrote {options.output}: {repaired.summary()}"]
        if options.inverse is not None and invertible:
            lines.append(_invert(options.inverse, repaired.field, spacing))
            facts["inverse"] = str(options.inverse)
        elif options.inverse is not None:
            lines.append(f"{options.inverse} is not written: the field has no inverse")
        report.emit(facts, options.json, "\n".join(lines))
    return 0 if invertible or options.inverse is None else 1


def _read(path: Path) -> NDArray[Any]:
    import numpy as np

    with path.open("rb") as file:
        try:
            array: NDArray[Any] = np.lib.format.read_array(file, allow_pickle=False)
        except (ValueError, EOFError) as error:
            raise ValueError(f"{path}: not an array of numbers in NumPy's format .npy: {error}") from error
    return array


def _write(path: Path, field: NDArray[np.float64]) -> None:
    import numpy as np

    from quasiharmonic.io import write_whole

    write_whole(path, lambda file: np.save(file, field))


def _invert(path: Path, field: NDArray[np.float64], spacing: float | list[float]) -> str:
    """Write the inverse field, and return its summary."""
    from quasiharmonic.apps.displacement_fields.field_inversion import inverse_field

    back = inverse_field(field, spacing=spacing)
    _write(path, back.field)
    return f"wrote {path}: {back.summary()}"


def _border(field: NDArray[Any]) -> NDArray[np.bool_]:
    """Return a mask of the border's pixels."""
    import numpy as np

    border = np.ones(field.shape[:2], dtype=bool)
    border[(slice(1, -1),) * border.ndim] = False
    return border
