"""What a node reports about itself: configuration, graph membership, machine id."""
