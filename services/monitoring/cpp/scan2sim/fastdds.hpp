// C++ monitor over Fast DDS 2, the default middleware of ROS 2, with ROS 2's names of topics and types: works without ROS 2
// beside nodes of ROS 2.
//
//   scan2sim::fastdds::Monitor node({"talker"});
//   auto publisher = node.create_publisher<std::string>(scan2sim::fastdds::string_type(), "chatter");
//   publisher.publish("hello");
//
// Types: `string_type` (std_msgs/String), or a TypeSupport of fastddsgen whose name is as ROS 2's: the type String of
// module std_msgs::msg is `std_msgs::msg::dds_::String_`. Link with -lfastrtps -lfastcdr.
#pragma once

#include <fastcdr/Cdr.h>
#include <fastcdr/FastBuffer.h>
#include <fastdds/dds/domain/DomainParticipant.hpp>
#include <fastdds/dds/domain/DomainParticipantFactory.hpp>
#include <fastdds/dds/publisher/DataWriter.hpp>
#include <fastdds/dds/publisher/Publisher.hpp>
#include <fastdds/dds/publisher/qos/DataWriterQos.hpp>
#include <fastdds/dds/subscriber/DataReader.hpp>
#include <fastdds/dds/subscriber/DataReaderListener.hpp>
#include <fastdds/dds/subscriber/SampleInfo.hpp>
#include <fastdds/dds/subscriber/Subscriber.hpp>
#include <fastdds/dds/subscriber/qos/DataReaderQos.hpp>
#include <fastdds/dds/topic/Topic.hpp>
#include <fastdds/dds/topic/TopicDataType.hpp>
#include <fastdds/dds/topic/TypeSupport.hpp>

#include <cstdlib>
#include <list>
#include <memory>
#include <stdexcept>

#include "monitor.hpp"

namespace scan2sim::fastdds {

namespace dds = eprosima::fastdds::dds;
namespace rtps = eprosima::fastrtps::rtps;

// std_msgs/String; its C++ type is std::string.
class StringType : public dds::TopicDataType {
 public:
  StringType() {
    setName("std_msgs::msg::dds_::String_");
    m_typeSize = 1 << 12;  // grows with the message
    m_isGetKeyDefined = false;
  }
  bool serialize(void* data, rtps::SerializedPayload_t* payload) override {
    eprosima::fastcdr::FastBuffer buffer(reinterpret_cast<char*>(payload->data), payload->max_size);
    eprosima::fastcdr::Cdr cdr(buffer, eprosima::fastcdr::Cdr::DEFAULT_ENDIAN, eprosima::fastcdr::Cdr::DDS_CDR);
    payload->encapsulation = cdr.endianness() == eprosima::fastcdr::Cdr::BIG_ENDIANNESS ? CDR_BE : CDR_LE;
    try {
      cdr.serialize_encapsulation();
      cdr << *static_cast<std::string*>(data);
    } catch (const eprosima::fastcdr::exception::Exception&) {
      return false;
    }
    payload->length = static_cast<std::uint32_t>(cdr.getSerializedDataLength());
    return true;
  }
  bool deserialize(rtps::SerializedPayload_t* payload, void* data) override {
    eprosima::fastcdr::FastBuffer buffer(reinterpret_cast<char*>(payload->data), payload->length);
    eprosima::fastcdr::Cdr cdr(buffer, eprosima::fastcdr::Cdr::DEFAULT_ENDIAN, eprosima::fastcdr::Cdr::DDS_CDR);
    try {
      cdr.read_encapsulation();
      cdr >> *static_cast<std::string*>(data);
    } catch (const eprosima::fastcdr::exception::Exception&) {
      return false;
    }
    return true;
  }
  std::function<std::uint32_t()> getSerializedSizeProvider(void* data) override {
    return [data] { return static_cast<std::uint32_t>(static_cast<std::string*>(data)->size() + 16); };
  }
  void* createData() override { return new std::string; }
  void deleteData(void* data) override { delete static_cast<std::string*>(data); }
  bool getKey(void*, rtps::InstanceHandle_t*, bool) override { return false; }
};

inline dds::TypeSupport string_type() { return dds::TypeSupport(new StringType); }

// ROS 2's name of a DDS type: "std_msgs::msg::dds_::String_" is "std_msgs/msg/String"; others are unchanged.
inline std::string ros_type(const std::string& name) {
  const auto split = name.find("::msg::dds_::");
  if (split == std::string::npos || name.back() != '_') return name;
  const auto leaf = split + std::strlen("::msg::dds_::");
  return name.substr(0, split) + "/msg/" + name.substr(leaf, name.size() - leaf - 1);
}

// Bytes of the message that this thread (de)serialized last.
inline thread_local std::size_t last_size = 0;

// Passes everything on to a type, and notes the size of its messages in `last_size`.
class MeteredType : public dds::TopicDataType {
 public:
  explicit MeteredType(dds::TypeSupport type) : type_(std::move(type)) {
    setName(type_->getName());
    m_typeSize = type_->m_typeSize;
    m_isGetKeyDefined = type_->m_isGetKeyDefined;
  }
  bool serialize(void* data, rtps::SerializedPayload_t* payload) override {
    const bool done = type_->serialize(data, payload);
    last_size = payload->length;
    return done;
  }
  bool deserialize(rtps::SerializedPayload_t* payload, void* data) override {
    last_size = own_size(*payload);
    return type_->deserialize(payload, data);
  }
  std::function<std::uint32_t()> getSerializedSizeProvider(void* data) override {
    return type_->getSerializedSizeProvider(data);
  }
  void* createData() override { return type_->createData(); }
  void deleteData(void* data) override { type_->deleteData(data); }
  bool getKey(void* data, rtps::InstanceHandle_t* handle, bool force_md5) override {
    return type_->getKey(data, handle, force_md5);
  }

 private:
  // Size without the trailer that scan2sim's nodes of cyclonedds append (services/transport/envelope.py).
  static std::size_t own_size(const rtps::SerializedPayload_t& payload) {
    constexpr std::size_t kTrailer = 48;
    if (payload.length < kTrailer || std::memcmp(payload.data + payload.length - 8, "scan2sim", 8) != 0)
      return payload.length;
    std::uint64_t size = 0;
    std::memcpy(&size, payload.data + payload.length - kTrailer, sizeof size);
    return size <= payload.length ? static_cast<std::size_t>(size) : payload.length;
  }

  dds::TypeSupport type_;
};

inline Gid as_gid(const rtps::GUID_t& guid) {
  Gid gid;
  std::copy_n(guid.guidPrefix.value, 12, gid.begin());
  std::copy_n(guid.entityId.value, 4, gid.begin() + 12);
  return gid;
}

// Publisher of messages of one type; thread-safe.
template <class Message>
class Publisher {
 public:
  Publisher(dds::DataWriter* writer, std::string topic, Meter& meter)
      : writer_(writer), topic_(std::move(topic)), meter_(&meter) {}

  // Whether the message was accepted.
  bool publish(Message message) {
    if (!writer_->write(&message)) return false;
    meter_->published(topic_, last_size);
    return true;
  }

  // Matched subscriptions.
  int get_subscription_count() const {
    dds::PublicationMatchedStatus status;
    writer_->get_publication_matched_status(status);
    return status.current_count;
  }

 private:
  dds::DataWriter* writer_;
  std::string topic_;
  Meter* meter_;
};

// Node whose publishers and subscriptions are monitored: once per period it publishes a record. Publishers end with it.
class Monitor {
 public:
  // Joins the DDS domain ROS_DOMAIN_ID (default: 0). Throws std::runtime_error if DDS refuses.
  explicit Monitor(MonitorSettings settings) {
    const char* set = std::getenv("ROS_DOMAIN_ID");
    const auto domain = static_cast<dds::DomainId_t>(set ? std::strtoul(set, nullptr, 10) : 0);
    auto* factory = dds::DomainParticipantFactory::get_instance();
    dds::DomainParticipantQos qos = dds::PARTICIPANT_QOS_DEFAULT;
    qos.name(settings.node_name);
    participant_ = checked(factory->create_participant(domain, qos));
    publisher_ = checked(participant_->create_publisher(dds::PUBLISHER_QOS_DEFAULT));
    subscriber_ = checked(participant_->create_subscriber(dds::SUBSCRIBER_QOS_DEFAULT));
    records_ = create_writer(string_type(), qualified(settings.publisher_topic, settings.node_namespace), 100);
    reporter_ = std::make_unique<Reporter>(
        std::move(settings), [this] { return graph(); },
        [this](const std::string& record) {
          std::string line = record;
          records_->write(&line);
        });
  }

  ~Monitor() {
    reporter_->stop();
    records_->wait_for_acknowledgments(eprosima::fastrtps::Duration_t(1, 0));  // of the last record
    for (auto& one : subscriptions_) one->reader->set_listener(nullptr);
    participant_->delete_contained_entities();
    dds::DomainParticipantFactory::get_instance()->delete_participant(participant_);
  }
  Monitor(const Monitor&) = delete;
  Monitor& operator=(const Monitor&) = delete;

  // Publisher of a topic, reliable, with a queue of `depth` messages.
  template <class Message>
  Publisher<Message> create_publisher(dds::TypeSupport type, const std::string& topic, int depth = 10) {
    const auto name = qualified(topic, reporter_->settings().node_namespace);
    const std::string type_name = type->getName();
    auto* writer = create_writer(std::move(type), name, depth);
    const std::lock_guard<std::mutex> lock(mutex_);
    writers_.push_back(writer);
    endpoints_.push_back({name, ros_type(type_name), true, as_gid(writer->guid()), true, false});
    return {writer, name, reporter_->meter()};
  }

  // Calls `callback`, in a thread of Fast DDS, with each message of a topic; reliable, or best effort.
  template <class Message>
  void create_subscription(dds::TypeSupport type, const std::string& topic, std::function<void(const Message&)> callback,
                           int depth = 10, bool reliable = true) {
    const auto name = qualified(topic, reporter_->settings().node_namespace);
    const std::string type_name = type->getName();
    auto* dds_topic = find_topic(std::move(type), name);
    dds::DataReaderQos qos = dds::DATAREADER_QOS_DEFAULT;
    qos.reliability().kind = reliable ? dds::RELIABLE_RELIABILITY_QOS : dds::BEST_EFFORT_RELIABILITY_QOS;
    qos.history().depth = depth;
    qos.endpoint().history_memory_policy = rtps::PREALLOCATED_WITH_REALLOC_MEMORY_MODE;
    qos.data_sharing().off();
    auto one = std::make_unique<Subscription<Message>>(name, reporter_->meter(), std::move(callback));
    one->reader = checked(subscriber_->create_datareader(dds_topic, qos, one.get()));
    const std::lock_guard<std::mutex> lock(mutex_);
    endpoints_.push_back({name, ros_type(type_name), false, as_gid(one->reader->guid()), reliable, false});
    subscriptions_.push_back(std::move(one));
  }

 private:
  struct AnySubscription : dds::DataReaderListener {
    dds::DataReader* reader = nullptr;
  };

  template <class Message>
  struct Subscription : AnySubscription {
    Subscription(std::string name, Meter& its_meter, std::function<void(const Message&)> its_callback)
        : topic(std::move(name)), meter(&its_meter), callback(std::move(its_callback)) {}

    void on_data_available(dds::DataReader* source) override {
      Message message;
      dds::SampleInfo info;
      while (source->take_next_sample(&message, &info) == eprosima::fastrtps::types::ReturnCode_t::RETCODE_OK) {
        if (!info.valid_data) continue;
        meter->received(topic, {last_size, now_ns(), info.source_timestamp.to_ns(), as_gid(info.sample_identity.writer_guid()),
                                static_cast<std::int64_t>(info.sample_identity.sequence_number().to64long())});
        callback(message);
      }
    }

    std::string topic;
    Meter* meter;
    std::function<void(const Message&)> callback;
  };

  template <class Entity>
  static Entity* checked(Entity* made) {
    if (!made) throw std::runtime_error("Fast DDS could not create an entity: see its log");
    return made;
  }

  dds::Topic* find_topic(dds::TypeSupport type, const std::string& name) {
    const std::lock_guard<std::mutex> lock(mutex_);
    if (!participant_->find_type(type->getName())) {
      const auto result = participant_->register_type(dds::TypeSupport(new MeteredType(type)));
      if (result != eprosima::fastrtps::types::ReturnCode_t::RETCODE_OK) throw std::runtime_error("the type can't be registered");
    }
    auto& topic = topics_[name];
    if (!topic) topic = checked(participant_->create_topic("rt" + name, type->getName(), dds::TOPIC_QOS_DEFAULT));
    return topic;
  }

  dds::DataWriter* create_writer(dds::TypeSupport type, const std::string& name, int depth) {
    auto* topic = find_topic(std::move(type), name);
    dds::DataWriterQos qos = dds::DATAWRITER_QOS_DEFAULT;
    qos.reliability().kind = dds::RELIABLE_RELIABILITY_QOS;
    qos.durability().kind = dds::VOLATILE_DURABILITY_QOS;
    qos.history().depth = depth;
    qos.endpoint().history_memory_policy = rtps::PREALLOCATED_WITH_REALLOC_MEMORY_MODE;
    qos.data_sharing().off();
    return checked(publisher_->create_datawriter(topic, qos));
  }

  Reporter::Graph graph() {
    const std::lock_guard<std::mutex> lock(mutex_);
    std::set<Gid> publishers, subscribers;
    for (const auto& one : endpoints_) (one.is_publisher ? publishers : subscribers).insert(one.gid);
    std::size_t others_sending = 0, others_receiving = 0;
    for (auto* writer : writers_) {
      dds::PublicationMatchedStatus status;
      writer->get_publication_matched_status(status);
      others_receiving += static_cast<std::size_t>(status.current_count);
    }
    for (const auto& one : subscriptions_) {
      dds::SubscriptionMatchedStatus status;
      one->reader->get_subscription_matched_status(status);
      others_sending += static_cast<std::size_t>(status.current_count);
    }
    return {endpoints_, publishers.size() + others_sending, subscribers.size() + others_receiving};
  }

  std::mutex mutex_;
  dds::DomainParticipant* participant_;
  dds::Publisher* publisher_;
  dds::Subscriber* subscriber_;
  dds::DataWriter* records_;
  std::map<std::string, dds::Topic*> topics_;
  std::vector<dds::DataWriter*> writers_;
  std::vector<Endpoint> endpoints_;
  std::vector<std::unique_ptr<AnySubscription>> subscriptions_;
  std::unique_ptr<Reporter> reporter_;
};

}  // namespace scan2sim::fastdds
