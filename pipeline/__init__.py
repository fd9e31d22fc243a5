"""The core: types, what a step is, geometry steps, store, readers and writers."""

import os

# numba's first choice, TBB, is too old on many machines, which it warns of at length
os.environ.setdefault("NUMBA_THREADING_LAYER_PRIORITY", "omp workqueue tbb")
