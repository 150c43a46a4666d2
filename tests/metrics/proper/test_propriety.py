"""The generator of the truth beats every spoilt copy of itself, in every score."""

import numpy as np
import pytest

from infgen.metrics.long_term.protocols import STEP_FEATURES, Scoring
from infgen.metrics.proper.context import CONTEXT
from infgen.metrics.proper.counts import score_ensemble
from infgen.metrics.proper.likelihood import (
    MOST_EVENTS,
    MOST_IN_RING,
    count_log_likelihood,
    step_log_likelihood,
)
from infgen.metrics.proper.outcomes import GONE
from infgen.metrics.proper.quantities import QUANTITIES, SCORES, read_course, read_courses
from infgen.metrics.proper.retrieval import LogCourse, retrieve, score_retrieved
from infgen.metrics.proper.spread import (
    flatness_error,
    rank_counts,
    spread_and_error,
    spread_skill,
)
from tests.metrics.proper.birth_death import COPIES, Town, draw, ensemble, towns

SCENES, MEMBERS = 100, 16
GENERATOR = "generator"


@pytest.fixture(scope="module")
def played():
    """Truth of each scene, and the courses of each forecaster's rollouts."""
    random = np.random.default_rng(0)
    places = towns(random, SCENES)
    truths = [draw(random, place) for place in places]
    members = [ensemble(random, place, MEMBERS) for place in places]
    found = {GENERATOR: members}
    for name, spoil in COPIES.items():
        found[name] = [spoil(random, courses) for courses in members]
    return truths, found


@pytest.fixture(scope="module")
def forecasts(played):
    """The same as numbers."""
    truths, found = played
    members = {name: [read_courses(some) for some in each] for name, each in found.items()}
    return [read_course(truth) for truth in truths], members


@pytest.fixture(scope="module")
def scored(forecasts):
    """Mean of the fair scores of each forecaster."""
    truths, found = forecasts
    return {
        name: np.mean(
            [
                score_ensemble(some, truth).mean(axis=0)
                for truth, some in zip(truths, members, strict=True)
            ],
            axis=0,
        )
        for name, members in found.items()
    }


def pooled(truths, members):
    """All scenes beside each other: [member, scene x window, quantity] and the truth."""
    forecast = np.concatenate([some.single for some in members], axis=1)
    return forecast, np.concatenate([truth.single for truth in truths])


@pytest.mark.parametrize("copy", COPIES)
def test_fair_scores_are_least_for_the_generator(scored, copy):
    for at, score in enumerate(SCORES):
        assert scored[GENERATOR][at] < scored[copy][at], score


@pytest.mark.parametrize("copy", COPIES)
def test_ranks_and_spread_are_right_for_the_generator_alone(forecasts, copy):
    truths, found = forecasts
    for at, quantity in enumerate(QUANTITIES):
        off = {}
        for name in (GENERATOR, copy):
            members, truth = (x[..., at] for x in pooled(truths, found[name]))
            flat = flatness_error(rank_counts(members, truth)[None])[0]
            parts = [x.mean(keepdims=True) for x in spread_and_error(members, truth)]
            with np.errstate(divide="ignore"):
                ratio = np.log(spread_skill(*parts)[0])
            off[name] = flat, abs(ratio)
        assert off[GENERATOR][0] < off[copy][0], quantity
        assert off[GENERATOR][1] < off[copy][1], quantity
        assert off[GENERATOR][1] < 0.15, quantity


@pytest.mark.parametrize("copy", COPIES)
def test_counts_are_likeliest_under_the_generator(played, copy):
    truths, found = played
    mean = {}
    for name in (GENERATOR, copy):
        scores = []
        for truth, some in zip(truths, found[name], strict=True):
            for events in ("entries", "exits"):
                true = getattr(truth, events).astype(float)
                pool = np.stack([getattr(one, events) for one in some]).astype(float)
                number = true.sum(axis=1, keepdims=True), pool.sum(axis=2, keepdims=True)
                scores.append(count_log_likelihood(*number, MOST_EVENTS).mean())
                scores.append(count_log_likelihood(true, pool, MOST_IN_RING).mean())
        mean[name] = np.reshape(scores, (SCENES, 4)).mean(axis=0)

    assert (mean[GENERATOR] > mean[copy]).all()


SHARES = [0.1, 0.2, 0.4, 0.2, 0.1]
OUTCOMES = {
    # Bin 2 is the most common; one in ten agents leaves half way.
    "generator": lambda random, shape: random.choice(5, p=SHARES, size=shape),
    "collapsed": lambda random, shape: np.full(shape, 2),
    "emptied": lambda random, shape: np.full(shape, GONE),
    "frozen": lambda random, shape: np.zeros(shape, dtype=np.int64),
    "dispersed": lambda random, shape: random.choice(10, size=shape),
}


def outcomes(random, name, members, agents, steps):
    """Bins of every feature that the agents of some rollouts keep, until some are gone."""
    shape = members, len(STEP_FEATURES), agents
    found = np.repeat(OUTCOMES[name](random, shape)[..., None], steps, axis=-1)
    for row, feature in enumerate(STEP_FEATURES):
        if feature.scoring is Scoring.EVENT and name != "emptied":
            odds = {"generator": 0.3, "dispersed": 0.7}.get(name, 0.0)
            happens = random.random((members, agents, 1)) < odds
            found[:, row] = np.where(happens, 1, 0)
    if name == "generator":
        leaves = random.random((members, 1, agents, 1)) < 0.1
        found = np.where(leaves & (np.arange(steps) >= steps // 2), GONE, found)
    return found.astype(np.uint8)


def test_logged_outcomes_are_likeliest_under_the_generator():
    random = np.random.default_rng(1)
    logged = outcomes(random, GENERATOR, 1, 400, 8)[0]
    members = {name: outcomes(random, name, 32, 400, 8) for name in OUTCOMES}
    mean = {
        name: step_log_likelihood(logged, some, 2).mean(axis=1)
        for name, some in members.items()
    }

    for copy in set(OUTCOMES) - {GENERATOR}:
        assert (mean[GENERATOR] > mean[copy]).all(), copy


def test_logs_of_like_situations_are_forecast_best_by_the_generator():
    # Two kinds of place, which the context tells apart.
    random = np.random.default_rng(2)
    kinds = [Town(np.full((3, 3), mean), np.full((3, 3), mean)) for mean in (1, 4)]
    logs = [
        LogCourse(f"{kind}-{at}", context(kind), draw(random, kinds[kind]))
        for kind in range(2)
        for at in range(20)
    ]
    scores = {name: [] for name in (GENERATOR, *COPIES)}
    for log in logs:
        kind = int(log.scenario_id[0])
        members = ensemble(random, kinds[kind], MEMBERS)
        near = retrieve(log.scenario_id, log.context, logs)
        assert all(one.scenario_id[0] == str(kind) for one in near)
        scores[GENERATOR].append(score_retrieved(members, near).mean(axis=0))
        for name, spoil in COPIES.items():
            spoilt = spoil(random, members)
            scores[name].append(score_retrieved(spoilt, near).mean(axis=0))

    mean = {name: np.mean(values, axis=0) for name, values in scores.items()}
    for copy in COPIES:
        assert (mean[GENERATOR] < mean[copy]).all(), copy


def context(kind):
    return np.full(len(CONTEXT), kind, dtype=np.float32)


def test_an_empty_street_which_other_protocols_prefer_is_worse_than_persistence(scored):
    energy = SCORES.index("energy")

    assert scored["emptied"][energy] > 1.5 * scored["frozen"][energy]
