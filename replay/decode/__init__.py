"""Messages to columns: one decoder per way of coding, one table from message type to role.

``decoder_for(topic)`` gives a function from a block of ``Messages`` to a block of ``CanFrames``,
``Table`` or ``Images`` with ``header_ns``; what cannot be decoded is skipped in the ledger.
"""
