"""Scenes on the ground, found by image loss among rendered hypotheses.

The image loss has local minima in yaw and shape, and no gradient where a prediction does not overlap its object. Over
a finite set of hypotheses it needs none: every kind of object is rendered in many yaws, and these renderings are
compared with an image at every place of the ground (``bank.py``). What is found descends the gradient of the image loss
(``descent.py``), and what then still does not explain its part of the image is searched for again (``search.py``). Only
the image is read, no scene code.
"""
