"""Functions that read a model card."""

import re

import pandas as pd

REPO_ID = "someone/tdpg-Lava-v0"
TINY = dict(n_timesteps=800, n_episodes=20, mi_kwargs=dict(gradient_steps=2, warmup_gradient_steps=2))


def text_of(folder):
    return (folder / "README.md").read_text()


def blocks(folder, language):
    return re.findall(rf"^```{language}\n(.*?)^```$", text_of(folder), re.MULTILINE | re.DOTALL)


def costs_of(folder, scenario="Training"):
    return pd.read_csv(folder / "episodes.csv").query("scenario == @scenario")["cost"]
