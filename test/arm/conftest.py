"""Shapes that many descriptions have are fitted once."""

import pytest

from contact_reach_ros.arm import capsule_fit, link_capsules


@pytest.fixture(scope="session", autouse=True)
def fits_are_kept():
    """Fit the same shape once in the whole run: what a fit is depends on nothing else."""
    fit, kept = capsule_fit.fit_capsule, {}

    def fitted(balls, on_axis=False):
        key = balls.tobytes(), on_axis
        if key not in kept:
            kept[key] = fit(balls, on_axis)
        return kept[key]

    with pytest.MonkeyPatch.context() as patch:
        for module in (capsule_fit, link_capsules):
            patch.setattr(module, "fit_capsule", fitted)
        yield
