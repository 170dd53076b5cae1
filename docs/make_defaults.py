"""Write the table of defaults in ``docs/guide/algorithm.md`` from the presets: ``python docs/make_defaults.py``."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from sb3_tdpg.common.networks import MAX_TIME_VARYING_HORIZON
from sb3_tdpg.presets import DEFAULTS, LONG_HORIZON, POLICY_DEFAULTS, Defaults, PolicyDefaults

PAGE = Path(__file__).parent / "guide" / "algorithm.md"
BEGIN, END = "<!-- begin: made by docs/make_defaults.py -->\n", "<!-- end -->\n"
KINDS = dict(
    vector="vector",
    image="image (bytes)",
    depth="depth image (floats)",
    long=f"vector, horizon of {LONG_HORIZON} or more",
)
NAMES = dict(share='`cost_limit` of `beta="auto"`', total_epochs="epochs of `learn()`")
OF_ARCH = dict(encoder="`net_arch`: encoder", action_head="`net_arch`: action head")
OF_ARCH |= dict(encoder_activation_fn="activation of the encoder", action_head_activation_fn="activation of the head")
LONG_ONLY = ("skip", "skip_changes", "normalize_observations", "scale_actions", "shared_action_noise")


def shown(name: str, kind: str, value: Any) -> str:
    """Return a value as a user would type it, or text that explains the value."""
    if name == "batch_size":
        defaults = DEFAULTS[kind]
        return f"the steps of {defaults.batch_episodes} episodes" if defaults.batch_episodes else str(value or "all")
    if name == "features_extractor_kwargs" and value:
        pooled = f"means of {value['pool']} x {value['pool']} pixels, " if "pool" in value else ""
        layers = ", ".join(f"{n} ({size} x {size})" for n, size, _ in value["layers"])
        linear = f", {value['features_dim']} features" if "features_dim" in value else ""
        keypoints = ", keypoints" if value.get("keypoints") else ""
        return f"{pooled}channels {layers}{linear}{keypoints}"
    if name == "trv_dim" and kind == "long":
        return f"features + {value}"
    if value is None:
        words = dict(gamma="$1 - 8/T$, from 0.9 to 0.995", n_threads="torch's")
        return words.get(name, f"$T \\le$ {MAX_TIME_VARYING_HORIZON}" if name == "time_varying" else "none")
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, type):
        return value.__name__
    if isinstance(value, str):
        return f'`"{value}"`'
    if isinstance(value, (tuple, list, dict)):
        return "-".join(map(str, value)) or "none"
    text = f"{value:,}" if isinstance(value, int) else f"{value:g}"
    return f"1/{1 / value:.0f}" if len(text) > 6 else text


def table() -> str:
    """Make the table, which has a row for each argument whose default depends on the kind of problem."""
    rows = [(NAMES.get(name, f"`{name}`"), DEFAULTS, name) for name in Defaults._fields if name != "batch_episodes"]
    rows += [
        (f"policy: {OF_ARCH.get(name, f'`{name}`')}", POLICY_DEFAULTS, name)
        for name in PolicyDefaults._fields
        if name not in ("is_long", "features_extractor_class")
    ]
    lines = ["| argument | " + " | ".join(KINDS.values()) + " |", "|---" * (1 + len(KINDS)) + "|"]
    for title, presets, name in rows:
        cells = [shown(name, kind, getattr(presets[kind], name)) for kind in KINDS]
        lines.append(f"| {title} | {' | '.join(cells)} |")
    is_long = [POLICY_DEFAULTS[kind].is_long for kind in KINDS]
    for names, values in ((LONG_ONLY, is_long), (("squash_trv_mean",), [not x for x in is_long])):
        title = ", ".join(f"`{name}`" for name in names)
        lines.append(f"| policy: {title} | {' | '.join('yes' if x else 'no' for x in values)} |")
    return "\n".join(lines) + "\n"


def page() -> str:
    """Return the page with the table of the current presets."""
    text = PAGE.read_text(encoding="utf-8")
    return re.sub(f"(?<={re.escape(BEGIN)}).*?(?={re.escape(END)})", lambda _: table(), text, flags=re.DOTALL)


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
