"""What a command says at its end: a few sentences, or JSON."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from quasiharmonic.certificate import Certificate
    from quasiharmonic.problem import Problem
    from quasiharmonic.result import MapResult


def verdict(certificate: Certificate) -> dict[str, Any]:
    """The certificate's answer in the report's first line of keys."""
    return {
        "injective": certificate.injective,
        "bijective": certificate.bijective,
        "flipped": [int(t) for t in certificate.flipped],
        "degenerate": [int(t) for t in certificate.degenerate],
        "certificate": certificate.to_dict(),
    }


def sizes(problem: Problem) -> dict[str, Any]:
    """How large a problem is."""
    return {"vertices": problem.n, "triangles": len(problem.F), "fixed": len(problem.fixed)}


def of_map(result: MapResult, certificate: Certificate, output: Path) -> str:
    """Sentences about a map that was searched for and written."""
    lines = [f"wrote {output}: {certificate.summary()}"]
    if not certificate.injective:
        lines.append(result.status.value)
    lines.append(f"{result.iterations} iterations, {result.seconds:.3g} s, {result.linear_solver}")
    return "\n".join(lines)


def emit(facts: dict[str, Any], destination: str | None, text: str) -> None:
    """Print the sentences, write the JSON; with ``--json -`` standard output holds the JSON alone."""
    if destination == "-":
        print(json.dumps(facts, allow_nan=False))
        print(text, file=sys.stderr)
        return
    if destination is not None:
        from quasiharmonic.io import write_whole

        write_whole(destination, json.dumps(facts, indent=2, allow_nan=False).encode() + b"\n")
    print(text)
