"""A trained scene, or one in training, in a page of the browser.

The page is viser's. It says where its camera is, and gets pictures: ``session`` decides what is
drawn when, ``screen`` draws for one page, ``painter`` makes pixels, and ``panel``, ``stage`` and
``recorder`` are what the page shows besides.
"""
