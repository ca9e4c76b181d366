from __future__ import annotations

import time

import numpy as np
import pytest

from trilitenet.metrics.bootstrap import bootstrap, draws, interval


def test_the_interval_of_a_mean_is_the_textbook_one(rng: np.random.Generator) -> None:
    values = rng.normal(0.5, 0.1, 400)

    def mean(weights: np.ndarray) -> dict[str, np.ndarray]:
        return {"mean": weights @ values / weights.sum(axis=1)}

    low, high = interval(bootstrap(mean, 400, 2000)["mean"])
    error = 1.96 * values.std(ddof=1) / 20
    assert low == pytest.approx(values.mean() - error, abs=0.001)
    assert high == pytest.approx(values.mean() + error, abs=0.001)


def test_draws_are_with_replacement_and_repeatable() -> None:
    first, again = list(draws(7, 130, seed=3)), list(draws(7, 130, seed=3))
    assert [len(part) for part in first] == [100, 30]
    assert all((part.sum(axis=1) == 7).all() for part in first)
    assert first[0].max() > 1
    np.testing.assert_array_equal(np.concatenate(first), np.concatenate(again))
    assert not np.array_equal(first[0], next(draws(7, 100, seed=4)))


def test_undefined_draws_are_left_out() -> None:
    assert interval(np.array([np.nan, 0.2, 0.2, 0.2])) == pytest.approx((0.2, 0.2))
    assert np.isnan(interval(np.array([np.nan]))).all()
    assert bootstrap(lambda weights: {"a": weights.sum(axis=1)}, 3, 0) == {}


def test_values_come_in_the_order_of_the_draws_whichever_thread_is_first() -> None:
    def first_image(weights: np.ndarray) -> dict[str, np.ndarray]:
        time.sleep(0.002 * (weights[0, 0] % 3))
        return {"first": weights[:, 0].astype(float)}

    wanted = np.concatenate([part[:, 0] for part in draws(5, 950, seed=1)])
    np.testing.assert_array_equal(bootstrap(first_image, 5, 950, seed=1)["first"], wanted)


def test_an_error_in_a_thread_is_raised() -> None:
    def fail(weights: np.ndarray) -> dict[str, np.ndarray]:
        raise ValueError("broken")

    with pytest.raises(ValueError, match="broken"):
        bootstrap(fail, 5, 500)
