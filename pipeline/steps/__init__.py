"""The steps of the mission (D3.2, section 4.2), one file each."""
