"""What a log holds for the viewer Foxglove alone: the 3D view, the events as log lines, a layout.

The other readers of logs pass these topics by: their schemas are Foxglove's, not ours.
"""
