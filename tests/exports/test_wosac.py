"""Submissions against protobuf, our own reader, and hand-computed futures."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from infgen.exports.wosac import About, complete, encode_about, encode_futures, in_words
from infgen.metrics.wosac.rollouts import Rollouts, RolloutsError
from infgen.metrics.wosac.submission import read_submission
from infgen.scene import AgentType
from tests.exports.replays import replay, with_newcomer, without
from tests.exports.submission_proto import Submission

ABOUT = About(
    account_name="me@example.org",
    unique_method_name="InfGen",
    authors=("Ada", "Bo"),
    acknowledge_complies_with_closed_loop_requirement=True,
    num_model_parameters="11M",
    description="Ünïcode",
)


@pytest.fixture
def scene(crossing):
    """Ego, car and cyclist are there now; the pedestrian comes later."""
    return crossing()


@pytest.fixture
def rollouts(scene):
    return [replay(scene, at, 0.1 * at) for at in range(32)]


def of_other_kind(scene, row):
    agent_type = scene.tracks.agent_type.copy()
    agent_type[row] = AgentType.OTHER
    return replace(scene, tracks=replace(scene.tracks, agent_type=agent_type))


def test_protobuf_reads_what_is_written_and_would_write_the_same_bytes(scene, rollouts):
    data = encode_futures(complete(scene, rollouts).rollouts) + encode_about(ABOUT)

    message = Submission.FromString(data)

    assert message.SerializeToString() == data
    (one,) = message.scenario_rollouts
    assert one.scenario_id == "made-by-hand"
    assert len(one.joint_scenes) == 32
    ids = [each.object_id for each in one.joint_scenes[31].simulated_trajectories]
    assert ids == [100, 101, 103]
    path = one.joint_scenes[31].simulated_trajectories[0]
    assert list(map(len, (path.center_x, path.center_z, path.heading))) == [80, 80, 80]
    # 10 m/s from -40 m at step 0, in a world that starts at (1000, -2000).
    assert path.center_x[0] == pytest.approx(1000 - 40 + 11, abs=1e-4)
    assert path.center_y[79] == pytest.approx(-2000 + 3.1, abs=1e-4)


def test_protobuf_reads_who_submits_what():
    message = Submission.FromString(encode_about(ABOUT))

    assert message.submission_type == 1
    assert message.account_name == "me@example.org"
    assert list(message.authors) == ["Ada", "Bo"]
    assert message.description == "Ünïcode"
    assert message.num_model_parameters == "11M"
    assert message.acknowledge_complies_with_closed_loop_requirement
    assert message.HasField("uses_lidar_data")
    assert not message.uses_lidar_data
    assert not message.HasField("method_link")


@given(
    ids=st.lists(st.integers(-(2**31), 2**31 - 1), min_size=1, max_size=4, unique=True),
    rollouts=st.integers(1, 3),
    steps=st.integers(1, 90),
    seed=st.integers(0, 2**16),
)
def test_any_futures_are_read_back_by_our_own_reader(
    tmp_path_factory, ids, rollouts, steps, seed
):
    drawn = np.random.default_rng(seed).normal(0, 1e4, (4, rollouts, len(ids), steps))
    axes = drawn.astype(np.float32)
    given_ = Rollouts("abc", np.array(sorted(ids)), *axes)
    path = tmp_path_factory.mktemp("any") / "submission.binproto"
    path.write_bytes(encode_futures(given_) + encode_about(ABOUT))

    (found,) = read_submission(path, num_rollouts=rollouts)

    assert found.scenario_id == "abc"
    assert found.object_id.tolist() == sorted(ids)
    for name in ("x_m", "y_m", "z_m", "heading_rad"):
        np.testing.assert_array_equal(getattr(found, name), getattr(given_, name))


def test_objects_stand_in_the_order_of_the_log_whatever_that_of_the_rollouts(
    scene, rollouts
):
    expected = complete(scene, rollouts).rollouts
    mixed = [without(one, 101) for one in rollouts]
    ids = scene.tracks.id[:2][::-1]
    turned = [
        replace(
            one,
            **{
                name: getattr(one, name)[[1, 0, 2]]
                for name in (
                    "id",
                    "agent_type",
                    "size_lwh_m",
                    "xyz_m",
                    "heading_rad",
                    "valid",
                )
            },
            ego=1,
        )
        for one in rollouts
    ]

    found = complete(scene, turned).rollouts

    assert [one.id[:2].tolist() for one in turned] == [ids.tolist()] * 32
    assert len(mixed[0].id) == 2
    np.testing.assert_array_equal(found.object_id, expected.object_id)
    np.testing.assert_array_equal(found.x_m, expected.x_m)


def test_newcomers_are_left_out_and_only_eight_seconds_are_taken(crossing):
    scene = crossing(steps=140)
    rollouts = [with_newcomer(replay(scene, at), 40) for at in range(32)]

    found = complete(scene, rollouts).rollouts

    assert found.object_id.tolist() == [100, 101, 103]
    assert found.x_m.shape == (32, 3, 80)


def test_of_more_rollouts_the_first_by_index_are_taken(scene):
    rollouts = [replay(scene, at, float(at)) for at in range(40)][::-1]

    found = complete(scene, rollouts).rollouts

    shift_m = found.y_m[:, 0, 0] + 2000
    assert shift_m == pytest.approx(np.arange(32), abs=1e-3)


def test_agents_of_kind_other_keep_their_velocity(scene, rollouts):
    scene = of_other_kind(scene, 1)
    unplayed = [without(one, 101) for one in rollouts]

    futures = complete(scene, unplayed)

    assert futures.filled.tolist() == [101]
    found = futures.rollouts
    assert found.object_id.tolist() == [100, 101, 103]
    # It came from the south at 10 m/s; now it is at y = -60 + 10 m.
    after_s = 0.1 * np.arange(1, 81)
    expected_m = -2000 - 50 + 10 * after_s
    np.testing.assert_allclose(found.y_m[:, 1], np.tile(expected_m, (32, 1)), atol=1e-3)
    np.testing.assert_allclose(found.x_m[:, 1], 1000, atol=1e-3)
    np.testing.assert_allclose(found.heading_rad[:, 1], np.pi / 2, atol=1e-6)


def test_nobody_is_filled_who_is_played(scene, rollouts):
    assert complete(of_other_kind(scene, 1), rollouts).filled.tolist() == []


WRONG = {
    "too few": (lambda them: them[:31], "has 31 rollouts; expected 32"),
    "none": (lambda them: [], "has 0 rollouts; expected 32"),
    "too short": (
        lambda them: [
            *them[:5],
            replace(
                them[5],
                xyz_m=them[5].xyz_m[:, :80],
                heading_rad=them[5].heading_rad[:, :80],
                valid=them[5].valid[:, :80],
            ),
            *them[6:],
        ],
        "rollout 5 has 69 steps after now; expected 80",
    ),
    "an agent is missing": (
        lambda them: [*them[:31], without(them[31], 103)],
        "1 of 3 agents observed now do not live through all rollouts: 103",
    ),
    "not finite": (
        lambda them: [
            replace(them[0], xyz_m=them[0].xyz_m * np.float32(np.nan)),
            *them[1:],
        ],
        "rollout 0, agent 100, step 0 holds a value that is not finite",
    ),
}


@pytest.mark.parametrize("name", WRONG)
def test_wrong_rollouts_are_refused_by_scene_and_count(scene, rollouts, name):
    change, reason = WRONG[name]

    with pytest.raises(RolloutsError) as refused:
        complete(scene, change(rollouts))

    assert str(refused.value).startswith("scene made-by-hand: ")
    assert reason in str(refused.value)


def test_an_agent_that_leaves_is_refused_with_the_way_out(scene, rollouts):
    valid = rollouts[3].valid.copy()
    valid[1, 50:] = False
    left = [*rollouts[:3], replace(rollouts[3], valid=valid), *rollouts[4:]]

    with pytest.raises(RolloutsError, match=r"101 \(`infgen rollout -s rollout.mode=wosac"):
        complete(scene, left)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"account_name": "me"}, "account_name is 'me'; expected the email"),
        ({"unique_method_name": " "}, "expected a short name"),
        ({"authors": ()}, "authors is (); expected one name or more"),
        ({"num_model_parameters": "11 million"}, "expected a number such as 11M"),
        ({"uses_public_model_pretraining": True}, "public_model_names is empty"),
    ],
)
def test_what_waymo_would_not_take_is_refused(change, reason):
    with pytest.raises(ValidationError) as refused:
        replace(ABOUT, **change)

    assert reason in str(refused.value)


def test_the_number_of_parameters_is_filled_in_only_where_it_is_not_told():
    untold = replace(ABOUT, num_model_parameters="")

    assert untold.with_parameters(10_998_720).num_model_parameters == "11M"
    assert ABOUT.with_parameters(5).num_model_parameters == "11M"
    assert [in_words(n) for n in (999_195, 1_400_000, 12)] == ["999K", "1M", "12"]
