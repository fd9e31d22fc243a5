"""Who may use the pages: named drivers with roles."""
