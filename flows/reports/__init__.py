"""What a person looks at: a tile's page, a survey's, what is wrong with them."""
