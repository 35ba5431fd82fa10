"""A plugin of napari: separated files as layers, and a panel that separates the shown frame.

``napari.yaml`` declares it. `layers` reads and names and needs no napari; only `panel` imports it (extra ``napari``).
"""
