"""Where neighbouring tiles meet: the colours they show there, brought together and measured."""
