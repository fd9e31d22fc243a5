"""The core: types, what a step is, geometry steps, store, readers and writers."""
