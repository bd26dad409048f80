"""The 26 games of Atari 100k, played on the Arcade Learning Environment (ALE).

The semantics are DreamerV3's, with these differences:

- The time limit truncates an episode; it does not terminate it.
- An observation never shows frames from before the reset or the step.
- Every reset leads to the same game. ALE's reset keeps the console's memory and random
  numbers, and at least ten of the games depend on them.
- Sticky frames are drawn here from the episode's seed, not by ALE.
- The last life of bank_heist, which counts as 0, is a life.
"""

from __future__ import annotations

import re
from typing import Any

import numpy as np

from vawm.envs.host.frames import make_resize
from vawm.envs.host.simulator import Outcome
from vawm.envs.protocol import check_positive
from vawm.errors import InvalidInput, suggestion
from vawm.types import PyTree, image

GAMES = {
    "alien": "Alien",
    "amidar": "Amidar",
    "assault": "Assault",
    "asterix": "Asterix",
    "bank_heist": "BankHeist",
    "battle_zone": "BattleZone",
    "boxing": "Boxing",
    "breakout": "Breakout",
    "chopper_command": "ChopperCommand",
    "crazy_climber": "CrazyClimber",
    "demon_attack": "DemonAttack",
    "freeway": "Freeway",
    "frostbite": "Frostbite",
    "gopher": "Gopher",
    "hero": "Hero",
    "jamesbond": "Jamesbond",
    "kangaroo": "Kangaroo",
    "krull": "Krull",
    "kung_fu_master": "KungFuMaster",
    "ms_pacman": "MsPacman",
    "pong": "Pong",
    "private_eye": "PrivateEye",
    "qbert": "Qbert",
    "road_runner": "RoadRunner",
    "seaquest": "Seaquest",
    "up_n_down": "UpNDown",
}
"""Name of the ROM -> name in score tables."""

ID = r"(ALE/)?(?P<title>[A-Z]\w*?)(-ram)?(-?NoFrameskip|-?Deterministic)?(-ram)?-v\d"
"""Gymnasium's ids of games: "ALE/Breakout-v5", "BreakoutNoFrameskip-v4", "Breakout-ram-v4"."""

LIFE_LOSSES = ("ignore", "terminal", "end")
NOOP = 0  # ALE's number for the action that does nothing, in every game


class AtariSimulator:
    """One game as a `Simulator`; observations are `[image_size, image_size, 3]` uint8.

    An observation is the pixelwise maximum over the last `pooling` frames of a step at full
    resolution, resized. The first observation is the one screen after the no-ops. A step
    that ends early has fewer frames.

    Args:
      game: one of `GAMES`.
      frame_skip: frames per step; fewer if the episode ends within the step.
      pooling: number of frames at the end of a step to take the maximum over, at most those
        of the step.
      image_size: pixels per side.
      resize: "bilinear" as in Pillow, "area" as in OpenCV; see `make_resize`.
      noops: an episode starts with a random number of frames without action, 0 to `noops`,
        drawn from its seed. They count neither as steps nor for `max_frames`.
      sticky: probability that a frame repeats the action of the frame before, in [0, 1).
      life_loss: what the loss of a life does if the game continues. "ignore": nothing.
        "terminal": the step stops at that frame, `is_terminal` without `is_last`. "end":
        the episode ends at that frame, and the next reset starts a new game. (The rest of
        this game would depend on earlier actions.)
      clip_reward: return only the sign of a step's reward.
      max_frames: truncate an episode after this many frames: `is_last` without
        `is_terminal`.
      full_action_set: use all 18 actions, not only those with an effect in the game.

    Raises:
      InvalidInput: an unknown game or choice, an impossible number, or no ale-py.
    """

    obs: PyTree
    action_size: int
    discrete: bool = True
    episode_length: int | None = None

    def __init__(
        self,
        game: str,
        *,
        frame_skip: int,
        pooling: int,
        image_size: int,
        resize: str,
        noops: int,
        sticky: float,
        life_loss: str,
        clip_reward: bool,
        max_frames: int,
        full_action_set: bool,
    ):
        check_game(game)
        check_positive("frame_skip", frame_skip)
        check_positive("pooling", pooling)
        check_positive("image_size", image_size)
        check_positive("max_frames", max_frames)
        if isinstance(noops, bool) or not isinstance(noops, int) or noops < 0:
            raise InvalidInput("noops", noops, "use a whole number of at least 0")
        if not 0 <= sticky < 1:
            remedy = "use a probability of at least 0 and below 1"
            raise InvalidInput("sticky", sticky, remedy)
        if life_loss not in LIFE_LOSSES:
            remedy = f"choose one of {', '.join(LIFE_LOSSES)}"
            raise InvalidInput("life_loss", life_loss, remedy)

        self._ale = load(game)
        self._loaded = self._ale.cloneState(include_rng=True)
        actions = "getLegalActionSet" if full_action_set else "getMinimalActionSet"
        self._actions = getattr(self._ale, actions)()
        height, width = self._ale.getScreenDims()
        self._screens = np.empty((min(pooling, frame_skip), height, width, 3), np.uint8)
        self._resize = make_resize(resize, height=height, width=width, size=image_size)
        self._frame_skip = frame_skip
        self._noops = noops
        self._sticky = sticky
        self._life_loss = life_loss
        self._clip_reward = clip_reward
        self._max_frames = max_frames
        self.obs = image(image_size)
        self.action_size = len(self._actions)

    def reset(self, seed: int) -> np.ndarray:
        """Starts a game; `seed` decides its no-ops and its sticky frames."""
        self._random = np.random.default_rng(seed)
        self._restart()
        for _ in range(self._random.integers(self._noops + 1)):
            self._ale.act(NOOP)
            if self._over():
                self._restart()
        self._held = NOOP
        self._lives = self._ale.lives()
        self._frames = 0
        self._ale.getScreenRGB(self._screens[0])
        return self._resize(self._screens[0])

    def step(self, action: np.ndarray | int) -> Outcome:
        """Plays the action with this index for `frame_skip` frames."""
        if not 0 <= int(action) < self.action_size:
            remedy = f"use the index of an action, 0 to {self.action_size - 1}"
            raise InvalidInput("action", action, remedy)
        chosen = self._actions[int(action)]
        reward, played = 0.0, 0
        is_last = is_terminal = False
        while played < self._frame_skip and not (is_last or is_terminal):
            if self._random.random() >= self._sticky:
                self._held = chosen
            reward += self._ale.act(self._held)
            self._ale.getScreenRGB(self._screens[played % len(self._screens)])
            played += 1
            self._frames += 1
            over = self._over()
            lives = self._ale.lives()
            # No check for lives > 0: the last life of bank_heist counts as 0.
            lost = lives < self._lives and not over
            self._lives = lives
            ended = over or (lost and self._life_loss == "end")
            is_last = ended or self._frames >= self._max_frames
            is_terminal = over or (lost and self._life_loss != "ignore")
        return Outcome(
            obs=self._resize(self._screens[:played].max(axis=0)),
            reward=float(np.sign(reward)) if self._clip_reward else reward,
            is_last=is_last,
            is_terminal=is_terminal,
        )

    def picture(self) -> np.ndarray:
        """The whole screen, `[210, 160, 3]` uint8 in most games."""
        return self._ale.getScreenRGB()

    def close(self) -> None:
        """Frees the console."""
        self._ale = self._loaded = None

    def _restart(self) -> None:
        """Starts the game that loading the ROM and one reset lead to.

        A saved state does not contain all of the video chip and the screen; a reset does not
        restore the memory, the cartridge and the random numbers of the console. Both
        together restore everything.
        """
        self._ale.restoreState(self._loaded)
        self._ale.reset_game()

    def _over(self) -> bool:
        return self._ale.game_over(with_truncation=False)


def check_game(name: str) -> None:
    """Refuses a name outside `GAMES`; names the game of an id, else the nearest one.

    Raises:
      InvalidInput: with the name to use.
    """
    if name in GAMES:
        return
    remedy = f"{suggestion(name, GAMES)}choose one of {', '.join(GAMES)}"
    if found := re.fullmatch(ID, name):
        game = next((game for game, title in GAMES.items() if title == found["title"]), None)
        remedy = f"use {game!r}, which is this game" if game else f"is not among them; {remedy}"
        # Its frame skip and sticky actions are not those of Atari 100k.
        remedy += "; to play by the id itself, use suite gymnasium (gymnasium_task.py)"
    raise InvalidInput("game", name, remedy)


def load(game: str) -> Any:
    """An `ALEInterface` with the game loaded; logs errors only.

    ALE's sticky actions are off, because their random numbers cannot be seeded per episode.
    ALE's defaults are frame skip 1, no time limit, no end at a lost life, and the game's
    usual mode and difficulty.
    """
    try:
        import ale_py
        from ale_py import roms
    except ImportError as missing:
        remedy = 'ale-py is not installed: pip install "vawm[atari]"'
        raise InvalidInput("game", game, remedy) from missing

    ale_py.ALEInterface.setLoggerMode(ale_py.LoggerMode.Error)
    ale = ale_py.ALEInterface()
    ale.setFloat("repeat_action_probability", 0.0)
    ale.setInt("random_seed", 0)  # the default seed is the clock
    ale.loadROM(str(roms.get_rom_path(game)))
    return ale
