"""Names of the coordinates of observations, for figures and films.

Those of the tasks on MJX are in the order of their observations, which is dm_control's. Angles
are in rad, positions in m, velocities in either per second, forces of touch as log(1 + N).
"""

from __future__ import annotations

from vawm.envs import DOMAINS, TASKS, split

PLANAR = ("x", "z", "pitch")  # of a body that moves in a plane
LEGS = tuple(
    f"{side} {part}" for side in ("right", "left") for part in ("hip", "knee", "ankle")
)
BODIES = (
    "torso",
    *(f"{side} {part}" for side in ("right", "left") for part in ("thigh", "leg", "foot")),
)
CHEETAH = tuple(
    f"{end} {part}" for end in ("back", "front") for part in ("thigh", "shin", "foot")
)
HOPPER = ("waist", "hip", "knee", "ankle")


def _velocities(*of: str) -> tuple[str, ...]:
    return tuple(f"{name} velocity" for name in of)


OF_DOMAIN: dict[str, tuple[str, ...]] = {
    "acrobot": (
        *("upper arm sine", "lower arm sine", "upper arm cosine", "lower arm cosine"),
        *_velocities("shoulder", "elbow"),
    ),
    "ball_in_cup": (
        *("cup x", "cup z", "ball x", "ball z"),
        *_velocities("cup x", "cup z", "ball x", "ball z"),
    ),
    "cartpole": (
        *("cart position", "pole cosine", "pole sine"),
        *_velocities("cart", "pole"),
    ),
    "cheetah": ("z", "pitch", *CHEETAH, *_velocities(*PLANAR, *CHEETAH)),
    "finger": (
        *("proximal angle", "distal angle", "tip x", "tip z"),
        *_velocities("proximal", "distal", "spinner"),
        *("touch above", "touch below"),
    ),
    "hopper": (
        "z",
        "pitch",
        *HOPPER,
        *_velocities(*PLANAR, *HOPPER),
        "toe touch",
        "heel touch",
    ),
    "pendulum": ("pole cosine", "pole sine", "pole velocity"),
    "reacher": (
        *("shoulder angle", "wrist angle", "target x", "target y"),
        *_velocities("shoulder", "wrist"),
    ),
    "walker": (
        *(f"{body} {part}" for body in BODIES for part in ("cosine", "sine")),
        "height",
        *_velocities("z", "x", "pitch", *LEGS),
    ),
}
"""Domain -> names; a task may add `OF_TASK`."""
OF_TASK = {
    f"finger_{task}": ("target x", "target z", "target distance")
    for task in DOMAINS["finger"]
    if task != "spin"
}


def names(task: str, size: int) -> tuple[str, ...]:
    """A name for each of `size` coordinates: numbers where the task has no names for them."""
    if task in TASKS:
        known = OF_DOMAIN[split(task)[0]] + OF_TASK.get(task, ())
        if len(known) == size:
            return known
    return tuple(f"coordinate {i}" for i in range(size))
