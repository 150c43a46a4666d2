"""Which scenes a training step reads follows from its number."""

from pipeline.loader import draw_of_step, scenes_of_step


def test_every_epoch_visits_every_scene_once_in_another_order():
    visits = [scenes_of_step(step, batch=3, count=7, seed=5) for step in range(7)]

    flat = [row for batch in visits for row in batch]
    epochs = [flat[at : at + 7] for at in (0, 7, 14)]
    assert all(sorted(epoch) == list(range(7)) for epoch in epochs)
    assert epochs[0] != epochs[1]


def test_batches_larger_than_the_data_wrap_around():
    assert sorted(scenes_of_step(0, batch=5, count=2, seed=0)[:4]) == [0, 0, 1, 1]


def test_every_step_and_seed_has_its_own_draw():
    draws = {draw_of_step(step, seed) for step in range(50) for seed in range(50)}

    assert len(draws) == 2500
