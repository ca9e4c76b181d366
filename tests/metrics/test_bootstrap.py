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


def test_groups_are_drawn_as_wholes() -> None:
    weights = np.concatenate(list(draws(6, 130, seed=2, groups=(0, 0, 0, 1, 2, 2))))
    assert (weights[:, 1:3] == weights[:, :1]).all()
    assert (weights[:, 4] == weights[:, 5]).all()
    assert (weights[:, [0, 3, 4]].sum(axis=1) == 3).all()
    apart = np.concatenate(list(draws(6, 130, seed=2, groups=range(6))))
    np.testing.assert_array_equal(apart, np.concatenate(list(draws(6, 130, seed=2))))


def test_the_interval_of_like_images_in_groups_is_that_of_the_groups(rng: np.random.Generator) -> None:
    means = rng.normal(0.5, 0.1, 40)
    values, groups = np.repeat(means, 10), [index // 10 for index in range(400)]

    def mean(weights: np.ndarray) -> dict[str, np.ndarray]:
        return {"mean": weights @ values / weights.sum(axis=1)}

    low, high = interval(bootstrap(mean, 400, 2000, groups=groups)["mean"])
    assert high - low == pytest.approx(2 * 1.96 * means.std(ddof=1) / np.sqrt(40), rel=0.1)
    close, by = interval(bootstrap(mean, 400, 2000)["mean"])
    assert by - close == pytest.approx((high - low) / np.sqrt(10), rel=0.1)


@pytest.mark.parametrize("groups", [None, (0,)])
def test_a_single_image_gives_no_interval(groups: tuple[int, ...] | None) -> None:
    values = bootstrap(lambda weights: {"a": weights.sum(axis=1).astype(float)}, 1, 20, groups=groups)
    assert np.isnan(interval(values["a"])).all()
