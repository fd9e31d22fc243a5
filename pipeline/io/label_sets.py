"""Labels of published data sets in PLY files, recognized by the fields beside them, and mapped to our classes."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from scan2sim.pipeline.core.classes import CODE, UNCLASSIFIED


class LabelSet(NamedTuple):
    """A data set: its name, the fields of its files in lower case, that of its labels, and our class of each label."""

    name: str
    fields: frozenset[str]
    label: str
    classes: dict[int, str]

    def codes(self, labels: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """Our class codes (N,) of labels (N,); unclassified where a label isn't known."""
        table = np.full(256, UNCLASSIFIED, np.int64)
        for label, name in self.classes.items():
            table[label] = CODE[name]
        known = np.isin(labels, list(self.classes))
        return np.where(known, table[np.where(known, labels, 0).astype(np.int64)], UNCLASSIFIED)


LABEL_SETS = (
    LabelSet(  # Tan et al., "Toronto-3D", CVPR Workshops 2020
        "Toronto-3D",
        frozenset({"scalar_label", "scalar_gpstime", "scalar_scananglerank"}),
        "scalar_label",
        {
            1: "road", 2: "road", 3: "high_vegetation", 4: "building", 5: "wire", 6: "pole", 7: "vehicle",
            8: "wall_or_fence",
        },
    ),
    LabelSet(  # Roynard et al., "Paris-Lille-3D", IJRR 2018: the ten classes of its benchmark
        "Paris-Lille-3D",
        frozenset({"x_origin", "y_origin", "z_origin", "reflectance", "class"}),
        "class",
        {
            1: "terrain", 2: "building", 3: "pole", 4: "pole", 6: "wall_or_fence", 7: "person", 8: "vehicle",
            9: "high_vegetation",
        },
    ),
)  # fmt: skip


def matching(fields: Collection[str]) -> LabelSet | None:
    """The data set whose files have these fields (lower case), or None."""
    return next((one for one in LABEL_SETS if one.fields <= set(fields)), None)
