"""The few numbers of a line that a display shows."""

from vawm.runs.reports.headline import Headline

LINE = {
    "env_steps": 8,
    "updates": 2,
    "episode/return": 12.34,
    "loss/reconstruction": 1.0,
    "loss/dynamics": 0.25,
    "loss/value_alignment": 0.125,
    "loss/of_a_plugin": 0.5,
    "loss/actor": -3.0,
    "loss/critic": 2.0,
    "loss/replay_critic": 0.5,
    "loss/total": 1.375,
    "value_alignment/loss": 0.25,
    "value_alignment/weight": 0.5,
}


def taken(*lines):
    headline = Headline()
    for line in lines:
        headline.take(line)
    return headline


def test_the_world_model_is_all_losses_but_those_of_behaviour_and_the_total():
    headline = taken(LINE)
    assert headline.world_model == 1.875
    assert headline.critic == 2.5
    assert (headline.alignment, headline.weight) == (0.25, 0.5)
    assert headline.fields() == [
        "return 12.3",
        "world model 1.88",
        "value alignment 0.25 x 0.5",
        "critic 2.5",
    ]


def test_what_is_not_known_yet_is_left_out_but_for_the_return():
    assert taken({"env_steps": 8, "episode/return": None}).fields() == ["return -"]


def test_the_newest_number_stays_where_a_line_has_none():
    later = dict.fromkeys(LINE) | {"loss/critic": 7.0, "loss/actor": float("nan")}
    headline = taken(LINE, later)
    assert (headline.episode_return, headline.critic) == (12.34, 7.0)
    assert headline.world_model == 1.875
