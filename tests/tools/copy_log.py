"""A log written again by the mcap package: another compression, no chunks, fewer topics, edited messages."""

from pathlib import Path

from mcap.reader import make_reader
from mcap.writer import Writer


def copy_with(path, target, keep=None, edit=None, schema=None, change_metadata=None, **options) -> Path:
    """Copy a log.

    Args:
        keep: called with a topic; False leaves it out.
        edit: called with (topic, log time, data bytes); returns the data to write.
        schema: called with the text of a schema, bytes; returns the text to write.
        change_metadata: called with (name, table); returns the table to write.
        options: of mcap.writer.Writer.
    """
    with open(path, "rb") as source, open(target, "wb") as out:
        reader = make_reader(source)
        writer = Writer(out, **options)
        writer.start()
        for one in reader.iter_attachments():
            writer.add_attachment(one.create_time, one.log_time, one.name, one.media_type, one.data)
        for one in reader.iter_metadata():
            table = one.metadata if change_metadata is None else change_metadata(one.name, dict(one.metadata))
            writer.add_metadata(one.name, table)
        ids = {}
        for described, channel, message in reader.iter_messages(log_time_order=False):
            if keep is not None and not keep(channel.topic):
                continue
            if channel.topic not in ids:
                text = described.data if schema is None else schema(described.data)
                schema_id = writer.register_schema(described.name, described.encoding, text)
                ids[channel.topic] = writer.register_channel(channel.topic, channel.message_encoding, schema_id)
            data = message.data if edit is None else edit(channel.topic, message.log_time, message.data)
            writer.add_message(ids[channel.topic], message.log_time, data, message.publish_time)
        writer.finish()
    return Path(target)
