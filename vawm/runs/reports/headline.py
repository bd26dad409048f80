"""The few numbers that tell how a run goes, from a line of metrics."""

from __future__ import annotations

import dataclasses

from vawm.runs.reports.tracking import Line, finite

OF_BEHAVIOUR = ("loss/actor", "loss/critic", "loss/replay_critic")
TOTAL = "loss/total"


@dataclasses.dataclass
class Headline:
    """The newest of each number; None for one that is not known yet.

    Attributes:
      episode_return: mean return of the episodes that ended last.
      world_model: sum of the losses of the world model, value alignment with its weight too.
      alignment: value alignment, without its weight.
      weight: its weight.
      critic: loss of the critic, in imagination and, if it has one, in replay.
    """

    episode_return: float | None = None
    world_model: float | None = None
    alignment: float | None = None
    weight: float | None = None
    critic: float | None = None

    def take(self, line: Line) -> None:
        """Takes over what `line` has of these."""
        numbers = finite(line)
        losses = {name: x for name, x in numbers.items() if name.startswith("loss/")}
        model = [x for name, x in losses.items() if name not in (*OF_BEHAVIOUR, TOTAL)]
        critic = [x for name, x in losses.items() if name in OF_BEHAVIOUR[1:]]
        found = {
            "episode_return": numbers.get("episode/return"),
            "world_model": sum(model) if model else None,
            "alignment": numbers.get("value_alignment/loss"),
            "weight": numbers.get("value_alignment/weight"),
            "critic": sum(critic) if critic else None,
        }
        for name, value in found.items():
            if value is not None:
                setattr(self, name, value)

    def fields(self) -> list[str]:
        """Each known number with its name; the return in any case."""
        known = self.episode_return
        result = [f"return {'-' if known is None else format(known, '.1f')}"]
        if self.world_model is not None:
            result.append(f"world model {self.world_model:.3g}")
        if self.alignment is not None and self.weight is not None:
            result.append(f"value alignment {self.alignment:.3g} x {self.weight:.2g}")
        if self.critic is not None:
            result.append(f"critic {self.critic:.3g}")
        return result
