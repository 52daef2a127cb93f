"""Search for the map of one problem without inverted triangles (§9.2).

The search stops at the first map in which every triangle is strictly positive. Exact arithmetic verifies this on the
returned coordinates.
"""

from __future__ import annotations

import time

from quasiharmonic.geometry.exact.certificate import Certificate, certify
from quasiharmonic.problem import Problem
from quasiharmonic.problem.result import MapResult, Status
from quasiharmonic.solver.search.options import SearchOptions
from quasiharmonic.solver.search.search import Search
from quasiharmonic.solver.search.stages import Stages
from quasiharmonic.solver.search.strategy import stages_of
from quasiharmonic.util.arrays import ComplexArray, FloatArray


def search_map(problem: Problem, options: SearchOptions) -> MapResult:
    """Run the stages of a strategy on a problem and certify the best map; see `quasiharmonic.solve` for the result."""
    return finish_search(Search(problem, options), options.strategy)


def finish_search(search: Search, strategy: str | Stages, spent: float = 0.0) -> MapResult:
    """Run the stages of a search that have not run yet and certify the best map.

    The search is new, or its first stage ran in a batch. It took ``spent`` seconds before.
    """
    began = time.perf_counter()
    search.run(stages_of(strategy, search.problem))
    uv = search.problem.positions(search.best_map)
    certificate = certify(search.problem.F, uv, loops=search.problem.domain.loops)
    mu = None if search.best_field is None else search.best_field.mu
    return result_of(search, uv, certificate, mu, spent + time.perf_counter() - began)


def result_of(
    search: Search, uv: FloatArray, certificate: Certificate, mu: ComplexArray | None, seconds: float
) -> MapResult:
    """Return the result of a search from its map (n, 2), the map's certificate and its tensors' μ (f,)."""
    return MapResult(
        uv=uv,
        status=Status.INJECTIVE if certificate.injective else search.status,
        certificate=certificate,
        stages=search.stages,
        history=search.history,
        path=search.path,
        diagnosis=search.diagnosis,
        linear_solver=search.linear_solver,
        seconds=seconds,
        mu=mu,
        reference=search.best_reference,
        V=search.problem.V,
    )
