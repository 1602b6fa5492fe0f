"""A LiDAR's place among other sensors, from targets: motion capture (`mocap`) and cameras (`camera`)."""
