"""The only subpackage that touches files. It has four of its own; each imports only from those before it.

* `io.store`: atomic files, checks and codecs, and files that polsep keeps for itself: weights, checkpoints, rows.
* `io.raw`: raw frames in. `io.raw.frames.read_frames` reads every format in its table `READERS`, and
  `io.raw.sequences.open_sequence` opens a recording at any frame.
* `io.results`: separations out. `io.results.separation_writer.write_separation` writes one,
  `io.results.separation_reader.read_separated` reads it back, and `io.results.sequences` writes those of a video.
* `io.assets`: files of other programs: meshes, textures, materials.
"""
