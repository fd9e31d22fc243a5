"""Roads as data: reference lines, lanes' edges and kerbs of what was scanned and photographed (docs/roads.md)."""
