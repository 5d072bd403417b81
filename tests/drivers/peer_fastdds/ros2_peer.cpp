/* A program as an owner of a robot of ros2_control would write it in C++, on Fast DDS 2.9, without ROS.
 *
 *   ros2_peer DOMAIN STATES COMMANDS MESSAGES TARGET...
 *
 * The same words, behaviour and output as ../peer_0102/ros2_peer.c. Messages are written with Fast CDR by hand, so the
 * program announces the types' names alone, as rmw_fastrtps of ROS 2 Humble does.
 */
#include <csignal>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <iostream>
#include <string>
#include <thread>
#include <vector>

#include <fastcdr/Cdr.h>
#include <fastdds/dds/domain/DomainParticipant.hpp>
#include <fastdds/dds/domain/DomainParticipantFactory.hpp>
#include <fastdds/dds/publisher/DataWriter.hpp>
#include <fastdds/dds/publisher/Publisher.hpp>
#include <fastdds/dds/subscriber/DataReader.hpp>
#include <fastdds/dds/subscriber/SampleInfo.hpp>
#include <fastdds/dds/subscriber/Subscriber.hpp>
#include <fastdds/dds/topic/TopicDataType.hpp>
#include <fastdds/rtps/transport/UDPv4TransportDescriptor.h>

using namespace eprosima::fastdds::dds;
using eprosima::fastcdr::Cdr;
using eprosima::fastcdr::FastBuffer;
using eprosima::fastrtps::rtps::InstanceHandle_t;
using eprosima::fastrtps::rtps::SerializedPayload_t;

namespace {

constexpr int kMeetCycles = 500;
constexpr auto kPeriod = std::chrono::milliseconds(20);
constexpr std::uint32_t kLargest = 4096;
volatile std::sig_atomic_t stopped = 0;

/* sensor_msgs/JointState. */
struct JointState {
  std::int32_t sec;
  std::uint32_t nanosec;
  std::string frame;
  std::vector<std::string> names;
  std::vector<double> position, velocity, effort;

  void write(Cdr& out) const { out << sec << nanosec << frame << names << position << velocity << effort; }
  void read(Cdr& in) { in >> sec >> nanosec >> frame >> names >> position >> velocity >> effort; }
};

/* std_msgs/Float64MultiArray without dimensions. */
struct Targets {
  std::uint32_t dimensions = 0, offset = 0;
  std::vector<double> data;

  void write(Cdr& out) const { out << dimensions << offset << data; }
  void read(Cdr& in) { in >> dimensions >> offset >> data; }
};

/* Makes a message a type of Fast DDS. */
template <typename Message>
class TypeOf : public TopicDataType {
 public:
  explicit TypeOf(const char* name) {
    setName(name);
    m_typeSize = kLargest;
  }
  bool serialize(void* data, SerializedPayload_t* payload) override {
    FastBuffer buffer(reinterpret_cast<char*>(payload->data), payload->max_size);
    Cdr out(buffer, Cdr::DEFAULT_ENDIAN, Cdr::DDS_CDR);
    payload->encapsulation = CDR_LE;
    out.serialize_encapsulation();
    static_cast<Message*>(data)->write(out);
    payload->length = static_cast<std::uint32_t>(out.getSerializedDataLength());
    return true;
  }
  bool deserialize(SerializedPayload_t* payload, void* data) override {
    FastBuffer buffer(reinterpret_cast<char*>(payload->data), payload->length);
    Cdr in(buffer, Cdr::DEFAULT_ENDIAN, Cdr::DDS_CDR);
    in.read_encapsulation();
    static_cast<Message*>(data)->read(in);
    return true;
  }
  std::function<std::uint32_t()> getSerializedSizeProvider(void*) override {
    return [] { return kLargest; };
  }
  void* createData() override { return new Message(); }
  void deleteData(void* data) override { delete static_cast<Message*>(data); }
  bool getKey(void*, InstanceHandle_t*, bool) override { return false; }
};

template <typename Made>
Made* check(Made* made, const char* what) {
  if (made == nullptr) {
    std::cerr << "ros2_peer: cannot make the " << what << std::endl;
    std::exit(1);
  }
  return made;
}

/* A participant on loopback alone. */
DomainParticipant* participant_of(std::uint32_t domain) {
  DomainParticipantQos qos = PARTICIPANT_QOS_DEFAULT;
  auto udp = std::make_shared<eprosima::fastdds::rtps::UDPv4TransportDescriptor>();
  udp->interfaceWhiteList.push_back("127.0.0.1");
  qos.transport().use_builtin_transports = false;
  qos.transport().user_transports.push_back(udp);
  return check(DomainParticipantFactory::get_instance()->create_participant(domain, qos), "participant");
}

Topic* topic_of(DomainParticipant* participant, TopicDataType* type, const char* name) {
  TypeSupport support(type);
  support.register_type(participant);
  return check(participant->create_topic(name, support.get_type_name(), TOPIC_QOS_DEFAULT), name);
}

/* Takes all states; returns how many came, the newest in `latest`. */
unsigned long take_states(DataReader* reader, JointState& latest) {
  unsigned long came = 0;
  SampleInfo info;
  JointState state;
  while (reader->take_next_sample(&state, &info) == ReturnCode_t::RETCODE_OK) {
    if (!info.valid_data) continue;
    latest = state;
    came++;
  }
  return came;
}

void print(const JointState& state, unsigned long received) {
  std::printf("{\"version\": \"%d.%d.%d\", \"received\": %lu, \"position\": {", FASTRTPS_VERSION_MAJOR,
              FASTRTPS_VERSION_MINOR, FASTRTPS_VERSION_MICRO, received);
  for (std::size_t i = 0; i < state.names.size() && i < state.position.size(); i++)
    std::printf("%s\"%s\": %.6f", i ? ", " : "", state.names[i].c_str(), state.position[i]);
  std::printf("}}\n");
}

}  // namespace

int main(int argc, char** argv) {
  if (argc < 6) {
    std::cerr << "usage: ros2_peer DOMAIN STATES COMMANDS MESSAGES TARGET..." << std::endl;
    return 64;
  }
  for (int number : {SIGTERM, SIGINT}) std::signal(number, [](int) { stopped = 1; });
  const unsigned long messages = std::strtoul(argv[4], nullptr, 10);
  Targets targets;
  for (int i = 5; i < argc; i++) targets.data.push_back(std::strtod(argv[i], nullptr));

  DomainParticipant* participant = participant_of(static_cast<std::uint32_t>(std::strtoul(argv[1], nullptr, 10)));
  Topic* states = topic_of(participant, new TypeOf<JointState>("sensor_msgs::msg::dds_::JointState_"), argv[2]);
  Topic* commands = topic_of(participant, new TypeOf<Targets>("std_msgs::msg::dds_::Float64MultiArray_"), argv[3]);
  DataReader* reader = check(
      check(participant->create_subscriber(SUBSCRIBER_QOS_DEFAULT), "subscriber")
          ->create_datareader(states, DATAREADER_QOS_DEFAULT),
      "reader");
  DataWriter* writer = check(
      check(participant->create_publisher(PUBLISHER_QOS_DEFAULT), "publisher")
          ->create_datawriter(commands, DATAWRITER_QOS_DEFAULT),
      "writer");

  PublicationMatchedStatus matched;
  for (int cycle = 0; !stopped; cycle++) {
    writer->get_publication_matched_status(matched);
    if (matched.current_count > 0) break;
    if (cycle >= kMeetCycles) {
      std::cerr << "ros2_peer: nobody reads " << argv[3] << " within 10 s" << std::endl;
      return 2;
    }
    std::this_thread::sleep_for(kPeriod);
  }
  JointState latest;
  unsigned long received = 0;
  for (unsigned long sent = 0; sent < messages && !stopped; sent++) {
    writer->write(&targets);
    if (sent == 0) std::cout << "commanding" << std::endl;
    std::this_thread::sleep_for(kPeriod);
    received += take_states(reader, latest);
  }
  for (int cycle = 0; cycle < kMeetCycles; cycle++) {
    const unsigned long came = take_states(reader, latest);
    received += came;
    if (came > 0) break;
    std::this_thread::sleep_for(kPeriod);
  }
  print(latest, received);
  std::fflush(stdout);
  participant->delete_contained_entities();
  DomainParticipantFactory::get_instance()->delete_participant(participant);
  return 0;
}
