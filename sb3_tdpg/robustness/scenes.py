"""Perturbations of the scene, such as another texture or camera pose, which are keywords of the environment."""

from collections.abc import Mapping
from typing import Any

from sb3_tdpg.robustness.registry import check_severities

Severities = tuple[Mapping[str, Any], ...]  # the env_kwargs of each

# The true state, and with it the task, does not change: no mugs in other places.
SCENES: dict[str, dict[str, Severities]] = {
    "BallCatch-v0": {
        # Another texture, blended into the training texture.
        "texture": tuple(dict(texture=f"{share}%-turquoise_waves") for share in (20, 40, 60, 80, 100)),
        # By default the camera is 2 m high and looks up by 30 degrees.
        "camera_pose": tuple(
            dict(camera_pitch=pitch, camera_height=height)
            for pitch, height in ((31.0, 2.05), (32.0, 2.1), (34.0, 2.2), (37.0, 2.35), (40.0, 2.5))
        ),
    },
    "PandaGrasp-v0": {
        "camera_pose": tuple(dict(camera_shift=height) for height in (0.01, 0.02, 0.03, 0.045, 0.06)),
    },
}
"""Keywords by environment, perturbation and severity; add rows for your own environment."""


def scene_perturbations(env_id: str) -> dict[str, Severities]:
    """
    Return the perturbations in :data:`SCENES` of an environment: the ``env_kwargs`` of the five severities by name.

    :param env_id: A registered Gymnasium id, also in the ``module:id`` form.
    """
    rows = SCENES.get(env_id.rpartition(":")[2], {})
    for name, severities in rows.items():
        check_severities(f"SCENES[{env_id!r}][{name!r}]", severities)
    return dict(rows)
