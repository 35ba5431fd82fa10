"""The viewer: raw frames and results in a browser, on this machine, with nothing from outside.

`session` opens and separates, `pictures` and `readout` make what is seen, `guard` keeps strangers out, and `page`
lays it out with Gradio (extra ``view``). Only `page` and `server` import Gradio.
"""
