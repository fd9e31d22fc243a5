"""Files of scenarios: OpenSCENARIO XML, actors of Gazebo's worlds, shapes of actors."""
