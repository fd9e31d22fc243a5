"""Which steps make a tile or a survey, in order, and the settings of their steps."""
