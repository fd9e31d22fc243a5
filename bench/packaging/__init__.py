"""What an installation holds: licences, shared libraries, containers, size."""
