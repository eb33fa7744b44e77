"""Commands of a person to a running loop: set-points, and manual inputs."""
