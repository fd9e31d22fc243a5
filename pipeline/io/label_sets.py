"""Labels of published data sets in clouds: recognized in PLY files, named by the user, and mapped to our classes."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from scan2sim.pipeline.core.classes import (
    CODE,
    FIRST_USER_CODE,
    UNCLASSIFIED,
    parse_mapping,
    plain_name,
    unmapped_codes_warning,
)
from scan2sim.pipeline.core.errors import SettingError
from scan2sim.pipeline.core.types import U8


class LabelSet(NamedTuple):
    """A data set: its name, our class of each label, the fields of its PLY files in lower case, that of its labels."""

    name: str
    classes: dict[int, str]
    fields: frozenset[str] = frozenset()
    label: str = ""

    def codes(self, labels: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """Our class codes (N,) of labels (N,); unclassified where a label isn't known."""
        table = np.full(max(self.classes) + 1, UNCLASSIFIED, np.int64)
        for label, name in self.classes.items():
            table[label] = CODE[name]
        known = np.isin(labels, list(self.classes))
        return np.where(known, table[np.where(known, labels, 0).astype(np.int64)], UNCLASSIFIED)

    def mapping(self) -> dict[int, int]:
        """Our code of each label, and "unclassified" for codes that mean something else in LAS."""
        las = {code: UNCLASSIFIED for code in CODE.values() if code < FIRST_USER_CODE}
        return las | {label: CODE[name] for label, name in self.classes.items() if label < 256}


def field_notes(field: str | None) -> tuple[str, ...]:
    """Note on how a cloud's field of labels is read, if it isn't named as LAS's classes."""
    if field is None or field.endswith("classification"):
        return ()
    how = "LAS classes (2 ground, 6 building, ...); map other codes from 0 to 255 with --classes"
    return (f"field `{field}` is read as {how}",)


def _labels(**labels: tuple[int, ...]) -> dict[int, str]:
    """Class by label, from labels by class."""
    return {label: name for name, many in labels.items() for label in many}


SEMANTIC_KITTI = LabelSet(  # Behley et al., "SemanticKITTI", ICCV 2019
    "SemanticKITTI",
    _labels(
        road=(40, 44, 60), sidewalk=(48,), terrain=(49, 72), building=(50, 52), wall_or_fence=(51,),
        high_vegetation=(70, 71), pole=(80,), road_sign=(81,), unclassified=(99,),
        vehicle=(10, 11, 13, 15, 16, 18, 20, 252, 256, 257, 258, 259), person=(30, 31, 32, 253, 254, 255),
    ),
)  # fmt: skip
LABEL_SETS = (
    LabelSet(  # Tan et al., "Toronto-3D", CVPR Workshops 2020
        "Toronto-3D",
        _labels(
            road=(1, 2), high_vegetation=(3,), building=(4,), wire=(5,), pole=(6,), vehicle=(7,), wall_or_fence=(8,)
        ),
        frozenset({"scalar_label", "scalar_gpstime", "scalar_scananglerank"}),
        "scalar_label",
    ),
    LabelSet(  # Roynard et al., "Paris-Lille-3D", IJRR 2018: the ten classes of its benchmark
        "Paris-Lille-3D",
        _labels(
            terrain=(1,), building=(2,), pole=(3, 4), wall_or_fence=(6,), person=(7,), vehicle=(8,),
            high_vegetation=(9,),
        ),
        frozenset({"x_origin", "y_origin", "z_origin", "reflectance", "class"}),
        "class",
    ),
    LabelSet(  # Liao et al., "KITTI-360", PAMI 2022: ids of its labels.py
        "KITTI-360",
        _labels(
            terrain=(6, 22), road=(7, 9), sidewalk=(8,), rail=(10,), building=(11, 16, 34, 36, 39, 40, 41, 42),
            wall_or_fence=(12, 13, 14, 35), bridge_deck=(15,), pole=(17, 18, 37, 38), road_sign=(19, 20),
            high_vegetation=(21,), person=(24, 25), vehicle=(26, 27, 28, 29, 30, 31, 32, 33, 43),
        ),
        frozenset({"semantic", "instance", "visible"}),
        "semantic",
    ),
    SEMANTIC_KITTI,
    LabelSet(  # Hackel et al., "Semantic3D.net", ISPRS Annals 2017
        "Semantic3D",
        _labels(
            road=(1,), terrain=(2,), high_vegetation=(3,), low_vegetation=(4,), building=(5,), wall_or_fence=(6,),
            low_noise=(7,), vehicle=(8,),
        ),
    ),
    LabelSet(  # Varney et al., "DALES", CVPR Workshops 2020
        "DALES",
        _labels(
            terrain=(1,), high_vegetation=(2,), vehicle=(3, 4), wire=(5,), wall_or_fence=(6,), pole=(7,), building=(8,)
        ),
    ),
)  # fmt: skip
MIN_KNOWN_SHARE = 0.98
"""Share of a cloud's labelled points with ids of SemanticKITTI from which they seem to be its labels."""


def matching(fields: Collection[str]) -> LabelSet | None:
    """The data set whose files have these fields (lower case), or None."""
    return next((one for one in LABEL_SETS if one.fields and one.fields <= set(fields)), None)


def parse_classes(text: str) -> dict[int, int]:
    """Mapping of a survey's codes to ours: the name of a data set ("SemanticKITTI"), or "65=noise,200=5".

    Raises:
        SettingError: as `classes.parse_mapping`, or no data set has that name.
    """
    named = next((one for one in LABEL_SETS if plain_name(one.name) == plain_name(text)), None)
    if named is None and text and "=" not in text:
        names = ", ".join(one.name for one in LABEL_SETS)
        raise SettingError("classes", f"{text[:40]!r} is no known data set", f"Name one of {names}, or write 65=noise")
    return named.mapping() if named else parse_mapping(text)


def codes_warning(count: npt.NDArray[np.integer], table: U8) -> str:
    """`classes.unmapped_codes_warning`, which names SemanticKITTI if the codes seem to be its labels."""
    warning = unmapped_codes_warning(count, table)
    labelled = np.delete(count, [0, UNCLASSIFIED])
    known = count[[label for label in SEMANTIC_KITTI.classes if label < 256]].sum()
    ground, plants = count[[40, 44, 48, 49, 72]].sum(), count[[70, 71]].sum()
    if not warning or known < MIN_KNOWN_SHARE * labelled.sum() or not (ground and plants):
        return warning
    return f"{warning}. They seem to be labels of SemanticKITTI: import with --classes SemanticKITTI"
