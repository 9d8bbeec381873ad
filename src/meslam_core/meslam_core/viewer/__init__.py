"""A page in the browser that shows a map while it grows, or a finished run.

`scene` holds what is shown, `page` shows it, `background_map` makes meshes and occupancy of the
regions' networks in a process of the lowest priority (`map_worker`), `replay` walks through a
finished run.
"""
