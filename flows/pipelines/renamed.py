"""Earlier names of steps and settings: the error about one of them names the new one."""

from __future__ import annotations

STEPS = {
    "dynamic_objects": "dynamic_objects",
    "instances": "instances",
    "reach": "photo_coverage",
    "finds": "detect_furniture",
    "pose_refinement": "pose_refinement",
    "photo_consistency": "photo_consistency",
    "view_selection": "view_selection",
    "colour_harmonization": "colour_harmonization",
    "place": "georeference",
}
"""Earlier name of a step: its name."""

SETTINGS = {
    "dynamic_objects": {"reach": "max_range", "camera": "camera_radius"},
    "instances": {"find": "detect"},
    "ground": {"reach": "cover_gap"},
    "walls": {"least_height": "min_height", "least_area": "min_area"},
    "facades": {"rise": "max_height"},
    "join": {"reach": "blend_distance"},
    "visibility": {"lacking": "mesh_distance"},
    "pose_refinement": {
        "worth": "min_gain_px",
        "turn": "rotation",
        "camera_turn": "camera_rotation",
        "wander": "correlation_length",
    },
    "unwrap": {"unseen": "unseen_texel_factor", "signs": "sign_texel_divisor"},
    "texture": {"continued": "inpaint"},
    "colour_harmonization": {"reach": "fade_distance"},
    "score": {"truth_reach": "truth_max_distance"},
    "track": {
        "anchors": "fixed_keyframes",
        "below": "max_below_camera",
        "beyond": "max_distance",
        "off": "max_error_deg",
        "views": "min_views",
        "survival": "min_tracked_share",
    },
    "cut": {"reach": "max_distance", "photo_reach": "photo_distance"},
}
"""By step: earlier name of a setting: its name."""


def current_name(path: str) -> str | None:
    """Today's name of the earlier `step` or `step.param`; None if it was never renamed."""
    step, _, param = path.partition(".")
    new_step = STEPS.get(step, step)
    new_param = SETTINGS.get(new_step, {}).get(param, param)
    new = f"{new_step}.{new_param}" if param else new_step
    return new if new != path else None
