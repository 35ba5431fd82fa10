"""The viewer: raw frames and results in a browser, on this machine, without network.

`session` opens and separates, `pictures` and `readout` draw, `guard` refuses foreign requests, `page` lays out the
page with Gradio (extra ``view``), and `events` updates it. Only `page`, `events` and `server` import Gradio.
"""
