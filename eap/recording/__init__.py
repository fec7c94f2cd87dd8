"""Recordings: values in MCAP, frames in pcapng, and what is done with these files.

- :mod:`~eap.recording.messages`: the values of one station in one cycle as a protobuf message;
- :mod:`~eap.recording.values_writer`: MCAP files of such messages;
- :mod:`~eap.recording.frames_writer`: pcapng files of frames;
- :mod:`~eap.recording.published`: the PDs of a plant, which give frames their variables.
"""
