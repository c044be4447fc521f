"""Writers and readers of topics: histories, acknowledgements, repairs and fragments.

`reader_proxy` is a matched reader as its writer sees it, and so the side of the writer;
`writer_proxy` is the side of the reader.
"""
