"""Plans and what runs as files: pictures, captured manifests, SROS2 documents. Pure."""
