"""Earlier names of steps, settings, fields of files and command line options: errors about one name the new one."""

from __future__ import annotations

STEPS = {
    "carve": "dynamic_objects",
    "things": "instances",
    "reach": "photo_coverage",
    "finds": "detect_furniture",
    "refine": "pose_refinement",
    "agreement": "photo_consistency",
    "choose": "view_selection",
    "level": "colour_harmonization",
    "place": "georeference",
    "slam": "track",
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
        "gps_chords": "gps_distances",
    },
    "slam": {"features": "count"},
    "cut": {"reach": "max_distance", "photo_reach": "photo_distance"},
}
"""By step (an earlier name if the setting had another name there): earlier name of a setting: its name."""

DRIVE_FIELDS = {f"tiles.{old}": f"tiles.{new}" for old, new in SETTINGS["cut"].items()}
"""Earlier name of a field of `drive.toml`: its name."""

OPTIONS = {
    "tile": {"--reach": "--max-distance", "--photo-reach": "--photo-distance"},
    "monitor": {"--spool": "--outbox"},
    "toolbox": {"--spool": "--outbox"},
    "teleop": {"--translator": "--adapter"},
}
"""By command: earlier name of an option of it or of its subcommands: its name."""


def current_name(path: str) -> str | None:
    """Today's name of the earlier `step` or `step.param`; None if it was never renamed."""
    step, _, param = path.partition(".")
    new_step = STEPS.get(step, step)
    new_param = (SETTINGS.get(new_step, {}) | SETTINGS.get(step, {})).get(param, param)
    new = f"{new_step}.{new_param}" if param else new_step
    return new if new != path else None
