"""Roads as vector data: reference lines, lane boundaries and kerbs from scans and photos (docs/roads.md)."""
