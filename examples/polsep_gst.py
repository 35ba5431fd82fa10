"""A GStreamer element: raw frames of a polarization camera in, one separated image out, to be looked at.

    python examples/polsep_gst.py "SOURCE ! polsep image=specular white-level=4095 ! videoconvert ! SINK"
    python examples/polsep_gst.py "aravissrc ! polsep gain=2 ! videoconvert ! autovideosink"

Frames are GRAY8, GRAY16_LE, or rggb of video/x-bayer, as which cameras may name their mosaics. Out comes RGB in 8 bits
and sRGB, of half the size, by the stream function of `color-affine`, of mono sensors of `analytic`; files for measuring
are made by `polsep video`. Needs GStreamer's Python (Debian: python3-gst-1.0) in a virtual environment made with
--system-site-packages.
"""

import sys

import gi
import numpy as np

import polsep
from polsep.kernels import (
    AnalyticImages,
    AnalyticOptions,
    ColorAffineImages,
    ColorAffineOptions,
    separate_analytic_half,
    separate_color_affine_half,
)

gi.require_version("Gst", "1.0")
gi.require_version("GstBase", "1.0")
gi.require_version("GstVideo", "1.0")
from gi.repository import GLib, GObject, Gst, GstBase, GstVideo  # noqa: E402

Gst.init(None)
SINK = "video/x-raw, format={GRAY8, GRAY16_LE}; video/x-bayer, format=rggb"
SOURCE = "video/x-raw, format=RGB"
#: sRGB of linear light, by 4096 steps.
TONES = np.linspace(0, 1, 4096)
TONES = np.rint(255 * np.where(TONES <= 0.0031308, 12.92 * TONES, 1.055 * TONES ** (1 / 2.4) - 0.055)).astype(np.uint8)


def template(name, direction, caps):
    """A pad that is always there."""
    return Gst.PadTemplate.new(name, direction, Gst.PadPresence.ALWAYS, Gst.Caps.from_string(caps))


def stream_of(size, layout):
    """The stream function for a layout, `color-affine` or of mono sensors `analytic`, and images that it fills."""
    if layout.bayer is None:
        return separate_analytic_half, AnalyticOptions(out=AnalyticImages.empty(size, layout))
    return separate_color_affine_half, ColorAffineOptions(out=ColorAffineImages.empty(size, layout), guided=True)


class Polsep(GstBase.BaseTransform):
    """The element ``polsep``. Light of the value 1 / gain is shown white."""

    __gstmetadata__ = ("polsep", "Filter/Video", "Diffuse or specular light of a raw frame", "The polsep authors")
    __gsttemplates__ = (
        template("sink", Gst.PadDirection.SINK, SINK),
        template("src", Gst.PadDirection.SRC, SOURCE),
    )
    image = GObject.Property(type=str, default="diffuse", nick="diffuse or specular")
    layout = GObject.Property(type=str, default="color", nick="color, mono or a specification")
    white_level = GObject.Property(type=float, default=0, nick="sample value that clips, 0: the largest of the type")
    black_level = GObject.Property(type=float, default=0, nick="sample value of no light")
    gain = GObject.Property(type=float, default=1, nick="of what is shown")

    def do_transform_caps(self, direction, caps, wanted):
        """Raw frames become RGB of half the size, and the other way round."""
        found = Gst.Caps.new_empty()
        for k in range(caps.get_size()):
            size = caps.get_structure(k)
            for other in Gst.Caps.from_string(SOURCE if direction == Gst.PadDirection.SINK else SINK):
                scaled = other.copy()
                for name in ("width", "height"):
                    known, value = size.get_int(name)
                    if known:
                        half = direction == Gst.PadDirection.SINK
                        scaled.set_value(name, value // 2 if half else Gst.IntRange(range(2 * value, 2 * value + 1)))
                rate = size.get_fraction("framerate")
                if rate[0]:
                    scaled.set_value("framerate", Gst.Fraction(rate[1], rate[2]))
                found.append_structure(scaled)
        return found.intersect_full(wanted, Gst.CapsIntersectMode.FIRST) if wanted else found

    def do_get_unit_size(self, caps):
        """Bytes of a frame."""
        structure = caps.get_structure(0)
        if structure.get_name() == "video/x-bayer":
            return True, self.row_bytes(structure) * structure.get_int("height")[1]
        return True, GstVideo.VideoInfo.new_from_caps(caps).size

    @staticmethod
    def row_bytes(structure):
        """Bytes of a row of one plane: padded to four."""
        name = structure.get_string("format")
        width = structure.get_int("width")[1] * {"GRAY16_LE": 2, "RGB": 3}.get(name, 1)
        return (width + 3) // 4 * 4

    def do_set_caps(self, sink, source):
        """Begin a stream of frames of one size."""
        if self.image not in ("diffuse", "specular"):
            return self.refuse(f"expected image=diffuse or image=specular, found image={self.image}", False)
        frame = sink.get_structure(0)
        self.stride, self.out_stride = self.row_bytes(frame), self.row_bytes(source.get_structure(0))
        self.size = frame.get_int("height")[1], frame.get_int("width")[1]
        self.type = np.dtype("<u2" if frame.get_string("format") == "GRAY16_LE" else "u1")
        try:
            self.filters = polsep.Layout.parse(self.layout)
            self.run, self.options = stream_of(self.size, self.filters)
            self.separate(np.zeros(self.size, self.type))  # levels and size are refused here
        except ValueError as error:
            return self.refuse(str(error), False)
        return True

    def refuse(self, text, answer):
        """End the pipeline with a line; return the answer."""
        self.post_message(Gst.Message.new_error(self, GLib.Error(text), ""))
        return answer

    def separate(self, raw):
        """The images of a frame, in the arrays of the stream."""
        white = self.white_level or float(np.iinfo(self.type).max)
        return self.run(raw, self.filters, self.black_level, white, self.options)

    def do_transform(self, before, after):
        """Separate one frame."""
        height, width = self.size
        rows = np.frombuffer(before.extract_dup(0, before.get_size()), np.uint8).reshape(height, self.stride)
        raw = np.ascontiguousarray(rows[:, : width * self.type.itemsize]).view(self.type)
        try:
            images = self.separate(raw)
        except ValueError as error:  # levels that were changed meanwhile
            return self.refuse(str(error), Gst.FlowReturn.ERROR)
        light = images.specular if self.image == "specular" else images.diffuse
        tones = TONES[(np.clip(light * self.gain, 0, 1) * (len(TONES) - 1)).astype(np.intp)]
        shown = np.zeros((height // 2, self.out_stride), np.uint8)
        shown[:, : width // 2 * 3] = np.broadcast_to(tones, (*tones.shape[:2], 3)).reshape(height // 2, -1)
        after.fill(0, shown.tobytes())
        return Gst.FlowReturn.OK


GObject.type_register(Polsep)
Gst.Element.register(None, "polsep", Gst.Rank.NONE, Polsep)


def play(description):
    """Play a pipeline to its end. Raises RuntimeError, in one line, where it fails."""
    try:
        pipeline = Gst.parse_launch(description)
    except GLib.Error as error:
        raise RuntimeError(f"expected a pipeline, found: {error.message}") from None
    pipeline.set_state(Gst.State.PLAYING)
    kinds = Gst.MessageType.EOS | Gst.MessageType.ERROR
    message = pipeline.get_bus().timed_pop_filtered(Gst.CLOCK_TIME_NONE, kinds)
    pipeline.set_state(Gst.State.NULL)
    if message.type == Gst.MessageType.ERROR:
        raise RuntimeError(message.parse_error()[0].message)


if __name__ == "__main__":
    try:
        play(" ".join(sys.argv[1:]) or "videotestsrc num-buffers=1 ! polsep ! fakesink")
    except RuntimeError as error:
        sys.exit(f"polsep_gst: error: {error}")
