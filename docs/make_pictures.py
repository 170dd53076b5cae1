"""Draw the pictures of the environments' pages: ``python docs/make_pictures.py``."""

from pathlib import Path

import numpy as np
from PIL import Image

from sb3_tdpg.envs.lava import LavaEnv

STARTS = (0.5, 2.0, 3.5, 4.5)  # m
OPEN_LOOP = (-5.0, 0.0, 1.5, 0.0, -1.5)


def lava(path: Path) -> None:
    """To the wall, and from there to the goal, whatever the sensor says: four start positions side by side."""
    films = []
    for start in STARTS:
        env = LavaEnv(render_mode="rgb_array")
        env.reset(seed=0)
        env._state = np.array([[start, 0.0]])
        film = [env.render()]
        for control in OPEN_LOOP:
            env.step(np.array([control]))
            film.append(env.render())
        films.append(film)
    frames = [Image.fromarray(np.concatenate(rows)) for rows in zip(*films, strict=True)]
    durations = [900] * (len(frames) - 1) + [2500]  # ms
    frames[0].save(path, save_all=True, append_images=frames[1:], duration=durations, loop=0)


if __name__ == "__main__":
    lava(Path(__file__).parent / "environments" / "lava.gif")
