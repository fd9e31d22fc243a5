"""What chains the rooms: the recipe of a tile and the command that runs it."""
