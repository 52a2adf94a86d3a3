"""DDS discovery: range, discovery server, the prober, liveliness, TCP, names."""
