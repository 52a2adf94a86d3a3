"""Who finds whom: ranges, servers, probes, liveliness, and finding each other again."""
