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
        help="make a displacement field of an image invertible",
        description="Make a displacement field invertible, with the least change: away from folds "
        "every bit is unchanged. The field is an array .npy of shape (height, width, 2), displacements "
        "along x, to the right, and y, down, in the unit of --spacing.",
        epilog="Exit status: 0 written, and certified to fold nowhere, as written; 1 written, but an inverse was asked "
        "for and there is none, since the border overlaps itself; 2 wrong input or call, or no such field was found, "
        "nothing written; 3 written, but the report failed.",
    )
    parser.add_argument("input", type=Path, metavar="INPUT", help=".npy file")
    parser.add_argument("-o", "--output", type=Path, required=True, help=".npy file to write")
    parser.add_argument(
        "--inverse",
        type=Path,
        metavar="FILE",
        help="write the inverse of the new field too, on the same grid, as .npy; NaN where the field does not reach",
    )
    parser.add_argument(
        "--spacing",
        type=float,
        nargs="+",
        default=[1.0],
        metavar="LENGTH",
        help="from a pixel to the next; or two, along x and along y (default: 1)",
    )
    parser.add_argument(
        "--min-jacobian",
        type=float,
        default=0.01,
        metavar="DET",
        help="lower bound of all Jacobian determinants (default: 0.01)",
    )
    parser.add_argument("--hold-border", action="store_true", help="keep the displacements of the border's pixels")
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
        held = _border(field) if options.hold_border else None
        try:
            mended = nearest_invertible(field, spacing=spacing, min_jacobian=options.min_jacobian, fixed=held)
        except RuntimeError as error:
            raise ValueError(str(error)) from error
    _write(options.output, mended.field)
    invertible = bool(mended.certificate.bijective)
    with report.after_writing(options.output):
        facts: dict[str, Any] = {
            "injective": mended.certificate.injective,
            "bijective": invertible,
            "folds": mended.folds,
            "moved": int(mended.moved_mask.sum()),
            "patches": mended.patches,
            "distance": mended.distance,
            "seconds": mended.seconds,
            "input": str(options.input),
            "output": str(options.output),
        }
        lines = [f"wrote {options.output}: {mended.summary()}"]
        if options.inverse is not None and invertible:
            lines.append(_invert(options.inverse, mended.field, spacing))
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
    from quasiharmonic.apps.displacement_fields.inverse import inverse_field

    back = inverse_field(field, spacing=spacing)
    _write(path, back.field)
    return f"wrote {path}: {back.summary()}"


def _border(field: NDArray[Any]) -> NDArray[np.bool_]:
    """Return a mask of the border's pixels."""
    import numpy as np

    border = np.ones(field.shape[:2], dtype=bool)
    border[(slice(1, -1),) * border.ndim] = False
    return border
