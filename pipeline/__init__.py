"""The pipeline: types, the step interface, geometry steps, the result store, readers and writers."""

import os

# numba prefers TBB, which is too old on many machines and then causes a long warning
os.environ.setdefault("NUMBA_THREADING_LAYER_PRIORITY", "omp workqueue tbb")
