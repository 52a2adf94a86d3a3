"""The nodes of the nine systems; their manifests are in manifests/."""
