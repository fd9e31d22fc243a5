"""Foreign inputs: one module per sort of file, each with `cases() -> Iterator[Case]`."""
