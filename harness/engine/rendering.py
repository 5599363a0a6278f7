"""The job that renders one view into the cache. It alone loads Mitsuba."""

from __future__ import annotations

from typing import Any


def render_into_cache(
    target_data: dict[str, Any], camera_data: dict[str, Any], render_data: dict[str, Any], folder: str
) -> tuple[bool, float]:
    """Render a view unless the cache holds it whole. Returns whether it was there, and the seconds that it took.

    Arguments are plain data, so that JSON can carry them.
    """
    from pathlib import Path

    from scenes.render.cache import cached_view
    from scenes.render.settings import RenderConfig
    from scenes.sensor.camera import CameraConfig, camera_of
    from scenes.target.custom import TargetConfig

    target, optics = TargetConfig.from_data(target_data), camera_of(CameraConfig.from_data(camera_data)).optics
    view, found = cached_view(target, optics, RenderConfig.from_data(render_data), Path(folder))
    return found, view.seconds
