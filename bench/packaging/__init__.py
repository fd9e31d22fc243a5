"""Content of an installation: licences, shared libraries, containers, size."""
