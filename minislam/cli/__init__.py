"""The commands: `main` lists the files, and the `add_parser` of each adds its commands."""
