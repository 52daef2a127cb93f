"""Charts of large surfaces come from a search on a coarse mesh; their promises are those of all charts."""

from __future__ import annotations

import numpy as np
import pytest

from quasiharmonic import unwrap
from quasiharmonic.surfaces import starfish
from shared.hinges import stretches

V, F = starfish(5, 30)  # 5,402 vertices, more than the search takes at once


@pytest.fixture(scope="module")
def result():
    return unwrap(V, F, jobs=1)


@pytest.mark.long
def test_charts_keep_the_promises(result):
    assert result.certificate.bijective
    assert result.stretch.p99 <= 1.5
    assert result.stretch.worst <= 3
    # The stretch of the file's coordinates, by singular values of their own.
    low, high = stretches(V, F, result)
    scale = np.sqrt(np.median(low) * np.median(high))
    assert max(high.max() / scale, scale / low.min()) < 3.5
    np.testing.assert_array_equal(result.vmapping[result.indices], F)
    # A starfish of a sixth of the vertices, which is searched as it is, has about as many charts.
    assert result.n_charts <= 2 * unwrap(*starfish(5, 12)).n_charts + 2


@pytest.mark.long
def test_the_number_of_threads_does_not_matter(result):
    again = unwrap(V, F, jobs=2)
    np.testing.assert_array_equal(result.uvs, again.uvs)
    np.testing.assert_array_equal(result.indices, again.indices)


@pytest.mark.long
def test_seams_and_charts_that_are_demanded_need_no_coarse_search(result):
    seam = F[len(F) // 2, :2]
    kept = unwrap(V, F, seams=[seam])
    assert kept.certificate.bijective
    assert (kept.seams == np.sort(seam)).all(axis=1).any()
    assert unwrap(V, F, max_charts=2).n_charts <= 2
