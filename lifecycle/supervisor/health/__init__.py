"""Who is alive: processes, nodes and other supervisors of the system."""
